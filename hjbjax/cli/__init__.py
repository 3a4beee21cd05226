"""The command ``hjbjax``: ``main``, its words (``command_line``), its files (``run_folder``), and ``doctor``."""
