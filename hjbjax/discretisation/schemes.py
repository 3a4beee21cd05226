"""Discretisations of the derivatives, as values."""

from hjbjax.problem.pytree import node


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
    stages = 1  # of the Runge–Kutta method that goes with the slopes when they march
    points = 2  # an axis must have

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
    stages = 2
    points = 2

    @property
    def chain(self) -> Upwind:
        """The monotone chain whose matrix makes the corrections."""
        return Upwind(subcell=self.subcell)


@node()
class Eno2:
    """Second order for ``march``: one-sided differences corrected by the smaller of two second differences.

        D⁺ − (h/2) m(s_i, s_{i+1}),   D⁻ + (h/2) m(s_i, s_{i−1}),   m(a, b) = a if |a| < |b| else b.

    The smoother stencil, node by node, as C.-W. Shu and S. Osher choose it. Wants equal spacings.
    """

    subcell = False
    stages = 2
    points = 3

    @property
    def chain(self) -> Upwind:
        """The monotone chain with the same fastest rate."""
        return Upwind()


@node()
class Weno5:
    """Fifth order where the value is smooth, for ``march``: weighted essentially non-oscillatory slopes.

    Each one-sided slope is a mean of three third-order ones with weights that favour the smoothest (see ``slopes``).
    Wants equal spacings and at least seven points an axis.
    """

    subcell = False
    stages = 3
    points = 7

    @property
    def chain(self) -> Upwind:
        """The monotone chain with the same fastest rate."""
        return Upwind()


Scheme = Upwind | Limited | Eno2 | Weno5
