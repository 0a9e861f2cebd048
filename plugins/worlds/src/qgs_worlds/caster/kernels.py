"""How kernels are compiled."""

from typing import Any

OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "arcp", "nsz"},
    # Cached kernels share the functions that they call by name, so that one loaded from the cache
    # may run another kernel's build of them, with other roundings; what is inlined is its own.
    "forceinline": True,
}
"""For functions that Python calls, and for those that allocate arrays."""

INNER: dict[str, Any] = {
    **OPTIONS,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
    # Counting references to the arrays that are passed takes longer than what is done with them.
    "_nrt": False,
}
"""For functions that kernels alone call and that allocate no arrays."""

REDUCING: dict[str, Any] = {**INNER, "fastmath": {"contract", "reassoc", "arcp", "nsz", "nnan"}}
"""For least values over a loop, which LLVM vectorises if no number is NaN."""
