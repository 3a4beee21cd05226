"""Types for annotations: arrays with named axes.

A user's function receives one state: ``State`` (n), ``Control`` (m), ``Disturbance`` (k). The solver works on all nodes
at once: ``Nodes`` and ``Mask`` (*grid). Nothing is checked at run time; the tests check the shapes.
"""

from typing import TypeAlias

import jax
import numpy as np
from jaxtyping import Bool, Float, Num, Shaped

Array: TypeAlias = jax.Array | np.ndarray  # NumPy on the host, JAX in a compiled program
Number: TypeAlias = float | Num[Array, ""]  # a number, which is traced inside a JAX transformation
Numbers: TypeAlias = jax.typing.ArrayLike  # a number or an array of numbers, as a user may write it
State: TypeAlias = Float[Array, " n"]
States: TypeAlias = Float[Array, "*batch n"]  # one state, or an array of states
Costate: TypeAlias = Float[Array, " n"]
Control: TypeAlias = Float[Array, " m"]
Disturbance: TypeAlias = Float[Array, " k"]
Nodes: TypeAlias = Float[Array, "*grid"]
Field: TypeAlias = Float[jax.Array, "*grid"]  # the values at all nodes inside a compiled program
AtNodes: TypeAlias = Shaped[jax.Array, "*grid"]  # values of any kind, including booleans
Scalar: TypeAlias = Num[jax.Array, ""]  # a number inside a compiled program
Verdict: TypeAlias = Bool[jax.Array, ""]  # a boolean inside a compiled program
Mask: TypeAlias = Bool[Array, "*grid"]
Key: TypeAlias = jax.Array  # of a random number generator
DType: TypeAlias = np.dtype | type | str
