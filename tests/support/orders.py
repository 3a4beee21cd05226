"""Orders of convergence."""

import numpy as np


def order_of(errors):
    """The slope of log error over log h for spacings that halve."""
    return -np.polyfit(np.arange(len(errors)), np.log2(errors), 1)[0]
