"""Which lines of a parser inputs reach: a tracer that looks at chosen functions only."""

import contextlib
import inspect
import sys
from collections.abc import Callable, Iterable
from types import CodeType, FrameType, FunctionType
from typing import Any

Line = tuple[str, int]


def code_objects(owners: Iterable[Any]) -> list[CodeType]:
    """The code of functions, and of the methods of classes, with everything nested in it."""
    found: list[CodeType] = []
    for owner in owners:
        if isinstance(owner, type):
            own = code_objects(value for value in vars(owner).values() if inspect.isroutine(value))
            found += [code for code in own if code.co_filename == inspect.getfile(owner)]  # not what NamedTuple adds
        else:
            function = inspect.unwrap(getattr(owner, "__func__", owner))
            found += _nested(function.__code__)
    return found


def functions_of(module: Any, without: Iterable[str] = ()) -> list[Any]:
    """Functions and classes a module defines itself, less the named ones (writers, constants)."""
    kinds = (FunctionType, type)
    own = [value for value in vars(module).values() if isinstance(value, kinds) and value.__module__ == module.__name__]
    return [value for value in own if value.__name__ not in set(without) and not getattr(value, "_is_protocol", False)]


def _nested(code: CodeType) -> list[CodeType]:
    return [code, *(inner for const in code.co_consts if isinstance(const, CodeType) for inner in _nested(const))]


def lines_of(owners: Iterable[Any]) -> set[Line]:
    """The lines of these functions and classes, but for those with ``def``."""
    return {
        (code.co_filename, line)
        for code in code_objects(owners)
        for _, _, line in code.co_lines()
        if line is not None and line != code.co_firstlineno
    }


def lines_reached(owners: Iterable[Any], run: Callable[[bytes], Any], inputs: Iterable[bytes]) -> set[Line]:
    """Those of ``lines_of`` that any of the inputs reaches. Exceptions pass."""
    codes, reached = set(code_objects(owners)), set()

    def on_line(frame: FrameType, event: str, _: Any) -> Any:
        if event == "line":
            reached.add((frame.f_code.co_filename, frame.f_lineno))
        return on_line

    def on_call(frame: FrameType, event: str, _: Any) -> Any:
        return on_line if frame.f_code in codes else None

    before = sys.gettrace()
    for data in inputs:
        sys.settrace(on_call)
        with contextlib.suppress(Exception):
            run(data)
        sys.settrace(before)
    return reached & lines_of(owners)
