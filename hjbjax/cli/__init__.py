"""The command ``hjbjax``: ``main``, its words (``command_line``), its files (``run_folder``), and ``doctor``.

``hjbjax.__main__`` starts it before slow imports, and ``interrupts`` handles Ctrl-C from there on.
"""
