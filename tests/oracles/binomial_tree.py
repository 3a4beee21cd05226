"""The tree of Cox, Ross and Rubinstein for American options."""

import numpy as np


def binomial_put(strike, rate, volatility, horizon, spot, steps=2000):
    """The price of an American put, by backward induction."""
    dt = horizon / steps
    up = np.exp(volatility * np.sqrt(dt))
    chance = (np.exp(rate * dt) - 1 / up) / (up - 1 / up)
    prices = spot * up ** np.arange(-steps, steps + 1, 2.0)
    values = np.maximum(strike - prices, 0)
    for _ in range(steps):
        prices = prices[:-1] * up
        values = np.exp(-rate * dt) * (chance * values[1:] + (1 - chance) * values[:-1])
        values = np.maximum(values, strike - prices)
    return float(values[0])
