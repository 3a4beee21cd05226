"""Problems that separate into blocks of states, each solved on its own grid.

``decompose`` is the public function; read it first. ``separation`` splits a function into a sum, a maximum or a minimum
of functions of fewer inputs, ``subsystems`` finds the blocks and constructs their problems, ``combination`` puts the
solutions of the blocks together.
"""
