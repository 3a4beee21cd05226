"""The question: what is asked, on which nodes, and how functions of one state are read.

Read ``problem`` and ``sets`` first, then ``grid`` with ``stretching``. A function of one state is evaluated on a
whole grid component by component: ``components``, by the rules of ``primitives`` and with indices that ``indices``
looks after; ``dependence`` reads off its jaxpr what it depends on, ``closures`` what it sees from outside. ``checks``
and ``arguments`` refuse; ``pytree`` makes dataclasses that JAX looks through.
"""
