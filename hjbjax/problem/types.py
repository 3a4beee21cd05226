"""Types for annotations: arrays that say what their axes are.

A function of the user's sees one state: ``State`` (n), ``Control`` (m), ``Disturbance`` (k). The solver sees all nodes
at once: ``Nodes`` and ``Mask`` (*grid). Nothing is checked while a program runs; the tests read the shapes.
"""

from typing import TypeAlias

import jax
import numpy as np
from jaxtyping import Bool, Float, Num, Shaped

Array: TypeAlias = jax.Array | np.ndarray  # on the host NumPy's, in a compiled program JAX's
Number: TypeAlias = float | Num[Array, ""]  # a number, which inside a JAX transformation is traced
Numbers: TypeAlias = jax.typing.ArrayLike  # what a user may write where one number or an array of them is wanted
State: TypeAlias = Float[Array, " n"]
States: TypeAlias = Float[Array, "*batch n"]  # one state, or an array of them
Costate: TypeAlias = Float[Array, " n"]
Control: TypeAlias = Float[Array, " m"]
Disturbance: TypeAlias = Float[Array, " k"]
Nodes: TypeAlias = Float[Array, "*grid"]
Field: TypeAlias = Float[jax.Array, "*grid"]  # the values at all nodes inside a compiled program
AtNodes: TypeAlias = Shaped[jax.Array, "*grid"]  # of any kind, truth values as well
Scalar: TypeAlias = Num[jax.Array, ""]  # and a number there
Verdict: TypeAlias = Bool[jax.Array, ""]  # and a truth value
Mask: TypeAlias = Bool[Array, "*grid"]
Key: TypeAlias = jax.Array  # of a random number generator
DType: TypeAlias = np.dtype | type | str
