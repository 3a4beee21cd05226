"""Linear plants as vector fields, whose matrices are leaves: all of a size share one program."""

import jax.numpy as jnp

from hjbjax.problem.pytree import pytree_dataclass


@pytree_dataclass()
class Linear:
    """ẋ = A x + b u with the output c x, shifted to a rest point."""

    a: object
    b: object
    c: object

    def drift(self, x):
        return self.a @ x

    def push(self, x):
        return jnp.asarray(self.b, x.dtype) + 0 * x

    def output(self, x):
        return self.c @ x
