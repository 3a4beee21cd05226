"""Feedback in use: closed loops, their paths, safety filters and the energies along paths.

- ``simulation``: ``simulate``; ``closed_loop`` integrates the loop, ``loop`` evaluates it at one state.
- ``feedback``: the control between the nodes; ``path``: the result; ``payments``: its cost compared with V;
  ``discounting``: discounts that depend on the state; ``sudden_changes``: random changes; ``pushing``: interventions.
- ``safety_filter``: a control that keeps the state in a tube; ``dissipation``: energies along paths.
"""
