"""The command ``hjbjax``: ``main``, its words (``command_line``), its files (``run_folder``), and ``doctor``.

``hjbjax.__main__`` starts it, before anything is imported that takes time; ``interrupts`` handles Ctrl-C from there on.
"""
