"""The command ``hjbjax``: ``main``, its words (``command_line``), its files (``results``), and ``doctor``."""
