"""The flags of the installed XLA, which ends the process when ``XLA_FLAGS`` holds a flag that it does not know."""

import importlib.util
import mmap
from pathlib import Path

EMITTERS = "xla_cpu_use_fusion_emitters"  # jaxlib 0.12 has no others and no longer has the flag
OLD_EMITTERS = f"--{EMITTERS}=false"
PARTS = "xla_cpu_parallel_codegen_split_count"  # LLVM modules into which XLA divides a program, 32 by default


def quick_to_compile() -> str:
    """The flags of the installed XLA that compile programs in the least time."""
    return " ".join(f"--{flag}={value}" for flag, value in ((EMITTERS, "false"), (PARTS, "1")) if knows(flag))


def knows(flag: str) -> bool:
    """True if the installed XLA has this flag. JAX does not start, since it would read ``XLA_FLAGS``.

    Each flag is a field of XLA's message ``DebugOptions``, and the library contains the descriptor of every field: tag
    10, the length of the name, the name, tag 24. The names of removed flags are there too, under another tag.
    """
    name = flag.encode()
    field = b"\x0a" + bytes([len(name)]) + name + b"\x18"
    return any(_contains(library, field) for library in _folder().glob("*jax_common*"))


def with_emitters() -> dict[str, bool]:
    """Options for ``jax.jit(compiler_options=...)`` that compile fusions as users' programs are compiled."""
    return {EMITTERS: True} if knows(EMITTERS) else {}


def _folder() -> Path:
    found = importlib.util.find_spec("jaxlib")
    assert found is not None
    assert found.origin is not None
    return Path(found.origin).parent


def _contains(file: Path, sought: bytes) -> bool:
    with file.open("rb") as opened, mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return content.find(sought) >= 0
