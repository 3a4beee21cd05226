"""Discretisations of the derivatives, as values."""

from hjbjax.pytree import node


@node(static=("central", "subcell"))
class Upwind:
    """First-order upwind differences: the Kushner–Dupuis chain, monotone on every grid.

    Order 1 where the drift rules. With ``central=True`` the artificial diffusion of upwinding is taken out as
    far as the chain stays monotone: an axis on which the noise is strong enough, a_ii ≥ h|f_i|, gets central
    differences, which are of order 2; the least diffusion that keeps the probabilities non-negative is added
    elsewhere. Without noise both are the same scheme.

    Args:
      central: whether to use central differences where they stay monotone.
      subcell: whether the boundary of a target {l ≤ 0} is met where l = 0 between two nodes, which wants l to be a
        signed distance or like one; otherwise the target is the nodes with l ≤ 0.
    """

    central: bool = True
    subcell: bool = False

    @property
    def chain(self) -> "Upwind":
        """The monotone chain that goes with the scheme: here the scheme itself."""
        return self


@node(static=("subcell",))
class Limited:
    """Second order where the solution is smooth: one-sided differences with limited slopes.

    With the second differences s_i along an axis the slopes are

        D⁺ − (h/2) φ(s_i, s_{i+1}),   D⁻ + (h/2) φ(s_i, s_{i−1}),   φ(a, b) = ab (a + b)/(a² + b²) if ab > 0 else 0

    (van Albada), with quadratic ghost values at ends that are not periodic. The scheme is no chain: the residual
    of the equation with these slopes is driven to zero by corrections with the matrix of the monotone one, from
    its answer. There is no certificate; the tolerance bounds that residual and the last step, in cost units.

    Args:
      subcell: as for ``Upwind``; on by default, since a target snapped to nodes is of first order.
    """

    subcell: bool = True

    @property
    def chain(self) -> Upwind:
        """The monotone chain whose matrix makes the corrections."""
        return Upwind(subcell=self.subcell)


Scheme = Upwind | Limited
