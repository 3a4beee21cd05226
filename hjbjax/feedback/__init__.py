"""Feedback in use: closed loops, their paths, safety filters and the energies along paths.

Read ``simulation`` for ``simulate``, ``feedback`` for the control between the nodes, ``closed_loop`` for what is
integrated, ``loop`` for it at one state and for noise at a target, ``path`` for what comes back; ``safety_filter``
filters a control and ``dissipation`` counts energies. Where the state is not measured, ``output_feedback`` closes the
loop through an observer.
"""
