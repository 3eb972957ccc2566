"""The simulator's innermost loops, in Python that Cython compiles; restricted as `handtouch.core.stages`."""

from handtouch.core.compiled import CompiledFinder

CompiledFinder.install()
