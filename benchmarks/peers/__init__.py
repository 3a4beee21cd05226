"""Other solvers, applied to the problems of hjbjax; ``speed`` and ``accuracy`` measure them."""
