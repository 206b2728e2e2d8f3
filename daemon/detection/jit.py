"""How the compiled loops are compiled: by numba, once for each machine, without the interpreter's lock."""

from __future__ import annotations

import numba

# numpy's rule for division: a zero divisor gives inf, and no check for it in the inner loop.
kernel = numba.njit(cache=True, nogil=True, error_model="numpy")
