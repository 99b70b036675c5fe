"""Checks a pickle's opcodes before execution, by a simulation of the types on its stack.

An allow-list of globals does not stop a small file from crashing the process or from running forever. Hashing a key of
tuples nested 500,000 deep overflows the C stack. Tuples that contain the previous tuple twice take 2^depth steps.
Python's hash of an integer is its remainder by 2^61 - 1, and that of a frozenset combines its members' hashes. So
thousands of keys can share a hash, and each new key is compared with all others. A memo index can allocate any amount
of memory. The check therefore refuses tuples, frozensets and integers beyond 64 bits as keys, and large memo indices.
Of the remaining keys, at most some dozens can share a hash.
"""

import pickle
import pickletools
from typing import Any

# The supported tools never write these, or they bypass the allow-list; LONG4 is for numbers over 2^2000.
REFUSED_OPCODES = frozenset(
    {"PERSID", "BINPERSID", "EXT1", "EXT2", "EXT4", "INST", "OBJ", "NEXT_BUFFER", "READONLY_BUFFER"} | {"DUP", "LONG4"}
)
_MAX_OPCODES = 400_000  # about a second; arrays take few opcodes, a tensor about 50
_BYTES_PER_OPCODE = 8  # of large files; one with 4,000 frames of 16 tensors has 13 bytes per opcode
_PUT_OPCODES = {"PUT", "BINPUT", "LONG_BINPUT"}
_GET_OPCODES = {"GET", "BINGET", "LONG_BINGET"}
_TUPLES = {"TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_TUPLE"}
_INTEGERS = {"INT", "LONG", "LONG1"}
# Types on the simulated stack; the first three are refused as keys.
_TUPLE = "tuple"
_FROZENSET = "frozenset"
_LARGE = "number beyond 64 bits"
_OTHER = "other"
_REFUSED_KEYS = (_TUPLE, _FROZENSET, _LARGE)
_MARK = "mark"


class OpcodeLimit:
    """Budget of opcodes for all pickles in one file of ``n_stored`` bytes, compressed or not."""

    def __init__(self, n_stored: int) -> None:
        self.max_opcodes = self.n_left = max(_MAX_OPCODES, n_stored // _BYTES_PER_OPCODE)

    def spend(self) -> None:
        """Count one opcode. Raises UnpicklingError above the limit."""
        self.n_left -= 1
        if self.n_left < 0:
            raise pickle.UnpicklingError(f"it has more than {self.max_opcodes} opcodes")


def check_opcodes(data: bytes, limit: OpcodeLimit | None = None) -> None:
    """Refuse unneeded opcodes, memo indices beyond the file's length, and keys that are slow to hash or compare.

    limit: budget of the file with the pickle; by default ``data`` is the whole file. Raises UnpicklingError; for
    malformed pickles, pickletools raises other exceptions too.
    """
    walk, limit = _StackSimulation(), limit or OpcodeLimit(len(data))
    for opcode, argument, _ in pickletools.genops(data):
        limit.spend()
        if opcode.name in REFUSED_OPCODES:
            raise pickle.UnpicklingError(f"it uses opcode {opcode.name}, which is not allowed")
        if opcode.name in _PUT_OPCODES and isinstance(argument, int) and argument > len(data):
            raise pickle.UnpicklingError(f"it stores memo entry {argument} in {len(data)} bytes")
        walk.step(opcode, argument)


class _StackSimulation:
    """Simulates an unpickler's stack and memo with the type of each value."""

    def __init__(self) -> None:
        self.stack: list[str] = []
        self.memo: dict[int, str] = {}

    def step(self, opcode: Any, argument: Any) -> None:
        """Simulate one opcode. Raises UnpicklingError for a refused key."""
        name = opcode.name
        if name in _PUT_OPCODES or name == "MEMOIZE":
            self.memo[len(self.memo) if name == "MEMOIZE" else argument] = self._top()
        elif name in _GET_OPCODES:
            self.stack.append(self.memo.get(argument, _OTHER))
        elif name == "MARK":
            self.stack.append(_MARK)
        elif name == "POP":
            self._top()
            self.stack.pop()
        else:
            self._apply(opcode, argument)

    def _apply(self, opcode: Any, argument: Any) -> None:
        """Pop an opcode's operands, check keys among them, and push its results."""
        taken = self._pop_operands(opcode)
        for key in _hashed(opcode.name, taken):
            if key in _REFUSED_KEYS:
                raise pickle.UnpicklingError(f"a {key} as a key, which is not allowed")
        self.stack += [_kind(opcode.name, argument)] * len(opcode.stack_after)

    def _pop_operands(self, opcode: Any) -> list[str]:
        operands = opcode.stack_before
        if pickletools.markobject not in operands:
            count = len(operands)
        else:
            below = operands.index(pickletools.markobject)
            count = below + len(self.stack) - self._last_mark()
        if count > len(self.stack):
            raise pickle.UnpicklingError("it takes more values than its stack has")
        taken = self.stack[len(self.stack) - count :]
        del self.stack[len(self.stack) - count :]
        return taken

    def _last_mark(self) -> int:
        for index in range(len(self.stack) - 1, -1, -1):
            if self.stack[index] is _MARK:
                return index
        raise pickle.UnpicklingError("it takes all values since a missing mark")

    def _top(self) -> str:
        if not self.stack:
            raise pickle.UnpicklingError("it takes more values than its stack has")
        return self.stack[-1]


def _kind(name: str, argument: Any) -> str:
    """The type that an opcode pushes."""
    if name in _TUPLES:
        return _TUPLE
    if name == "FROZENSET":
        return _FROZENSET
    return _LARGE if name in _INTEGERS and is_large(argument) else _OTHER


def is_large(number: int) -> bool:
    """Whether an integer needs more than 64 bits."""
    return not -(2**63) <= number < 2**64


def _hashed(name: str, taken: list[str]) -> list[str]:
    """The operands of an opcode that become keys or members of a set."""
    if name == "SETITEM":
        return taken[1:2]
    if name in ("SETITEMS", "DICT"):
        return taken[taken.index(_MARK) + 1 :: 2]
    if name in ("ADDITEMS", "FROZENSET"):
        return taken[taken.index(_MARK) + 1 :]
    return []
