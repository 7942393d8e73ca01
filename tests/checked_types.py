"""Types and shapes of arrays checked at every call, as `jaxtyping.jaxtyped` does at three times the cost."""

import functools
import inspect
from types import CodeType
from typing import Any, get_args

from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray
from jaxtyping._decorator import _destring_annotation
from jaxtyping._decorator import jaxtyped as plain_jaxtyped
from jaxtyping._storage import pop_shape_memo, push_shape_memo

_check = beartype(conf=BeartypeConf(is_pep484_tower=True))
_met: set[CodeType] = set()


def jaxtyped(fn: Any = None, *, typechecker: Any = None) -> Any:
    """Check a function; axis names hold within a call.

    A signature is bound where an axis names an argument, not at every call of every function; and a
    function that another one makes anew at every call is checked the first time.
    """
    if fn is None:
        return jaxtyped
    if inspect.isclass(fn):
        if "__dataclass_fields__" in vars(fn) and hasattr(fn.__init__, "__code__"):
            fn.__init__ = jaxtyped(fn.__init__)
        return fn
    if isinstance(fn, classmethod | staticmethod):
        return type(fn)(jaxtyped(fn.__func__))
    if isinstance(fn, property):
        return property(*(f and jaxtyped(f) for f in (fn.fget, fn.fset, fn.fdel)))
    if inspect.isgeneratorfunction(fn):  # its body runs later, among the axes of whoever asks
        return plain_jaxtyped(fn, typechecker=_check)
    if "<locals>" in fn.__qualname__:
        if fn.__code__ in _met:
            return fn
        _met.add(fn.__code__)
    hints = fn.__annotations__
    for name, hint in hints.items():
        if isinstance(hint, str):
            hints[name] = _destring_annotation(hint, fn.__globals__)
    checked, arrays = _check(fn), [array for hint in hints.values() for array in _arrays(hint)]
    if not arrays:
        return checked
    binds = any("{" in array.dim_str for array in arrays)
    signature = inspect.signature(fn)

    @functools.wraps(fn)
    def with_axes(*args: Any, **kwargs: Any) -> Any:
        push_shape_memo(_bound(signature, args, kwargs) if binds else {})
        try:
            return checked(*args, **kwargs)
        finally:
            pop_shape_memo()

    return with_axes


def _bound(signature: inspect.Signature, args: tuple, kwargs: dict[str, Any]) -> dict[str, Any]:
    bound = signature.bind(*args, **kwargs)
    bound.apply_defaults()
    return bound.arguments


def _arrays(hint: Any) -> list[Any]:
    """The array types within a type."""
    if inspect.isclass(hint) and issubclass(hint, AbstractArray):
        return [hint]
    return [array for part in get_args(hint) for array in _arrays(part)]
