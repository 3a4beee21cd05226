"""How a problem's functions of one state are read, and what is found in them before anything runs.

A function is evaluated on a whole grid component by component: ``components``, by an ``interpreter`` with the rules of
``jaxprs`` and with indices that ``indices`` looks after. ``dependence`` reads off its jaxpr what it depends on,
``closures`` what it sees from outside, and ``checks`` refuses what one state shows.
"""
