"""Stages of a tick over one pad's row, in Python that Cython compiles; `.pxd` files give the C types.

Restricted to what both give the same bits for: float and int scalars; + - * /, comparisons, math.exp, log,
sqrt, sin, cos and atan2 with arguments in their range. No exception may be raised.
"""

from handtouch.core.compiled import CompiledFinder

CompiledFinder.install()
