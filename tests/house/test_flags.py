"""XLA is asked for a flag before it is set: an unknown one ends the process."""

import jax
import pytest
import xla


@pytest.mark.parametrize(
    ("flag", "value"),
    [(xla.EMITTERS, False), (xla.PARTS, 1), ("xla_cpu_enable_fast_math", False), ("xla_cpu_has_no_such_flag", False)],
)
def test_a_flag_is_known_where_xla_takes_it(flag, value):
    try:
        jax.jit(lambda: 0, compiler_options={flag: value})()
    except jax.errors.JaxRuntimeError:
        assert not xla.knows(flag)
    else:
        assert xla.knows(flag)


def test_an_option_of_kernels_is_not_a_flag():
    """The library contains its name, and XLA ends the process if ``XLA_FLAGS`` does."""
    assert not xla.knows("xla_cpu_optimize_for_size")


def test_without_a_library_no_flag_is_known(tmp_path, monkeypatch):
    monkeypatch.setattr(xla, "_folder", lambda: tmp_path)
    assert not xla.knows("xla_cpu_enable_fast_math")
