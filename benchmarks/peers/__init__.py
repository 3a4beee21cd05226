"""Other people's solvers, set to the problems that ours solves; what measures them is ``speed`` and ``accuracy``."""
