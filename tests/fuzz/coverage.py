"""Which lines of a parser an input reaches: a tracer that looks at chosen functions only."""

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


class LineCoverage:
    """Lines and steps from line to line reached so far."""

    def __init__(self, codes: Iterable[CodeType]) -> None:
        self._codes = {code: code.co_filename for code in codes}
        self.lines: set[Line] = {
            (code.co_filename, line)
            for code in self._codes
            for _, _, line in code.co_lines()
            if line is not None and line != code.co_firstlineno
        }
        self.reached: set[Line] = set()
        self.steps: set[tuple[int, int, int]] = set()

    def trace(self, run: Callable[[bytes], Any], data: bytes) -> bool:
        """Run and note what was reached; True when it took a step no input took before. Exceptions pass."""
        steps: set[tuple[int, int, int]] = set()
        previous = 0

        def on_line(frame: FrameType, event: str, _: Any) -> Any:
            nonlocal previous
            if event == "line":
                steps.add((id(frame.f_code), previous, frame.f_lineno))
                previous = frame.f_lineno
            return on_line

        def on_call(frame: FrameType, event: str, _: Any) -> Any:
            return on_line if frame.f_code in self._codes else None

        before = sys.gettrace()
        sys.settrace(on_call)
        try:
            run(data)
        finally:
            sys.settrace(before)
            is_new = not steps <= self.steps
            if is_new:
                self.steps |= steps
                files = {id(code): name for code, name in self._codes.items()}
                self.reached |= {(files[code], line) for code, _, line in steps} & self.lines
        return is_new

    @property
    def missing(self) -> list[Line]:
        return sorted(self.lines - self.reached)

    @property
    def share(self) -> float:
        return len(self.reached) / max(1, len(self.lines))
