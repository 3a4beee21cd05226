"""Discretisations of the derivatives, as values."""

from hjbjax.pytree import node


@node(static=("central",))
class Upwind:
    """First-order upwind differences: the Kushner–Dupuis chain, monotone on every grid.

    Order 1 where the drift rules. With ``central=True`` the artificial diffusion of upwinding is taken out as
    far as the chain stays monotone: an axis on which the noise is strong enough, a_ii ≥ h|f_i|, gets central
    differences, which are of order 2; the least diffusion that keeps the probabilities non-negative is added
    elsewhere. Without noise both are the same scheme.

    Args:
      central: whether to use central differences where they stay monotone.
    """

    central: bool = True
