"""A look at a pickle's opcodes before any of them is executed: a walk over its stack that notes what lies there.

An allow-list of names does not stop a small file from ending the process or from keeping it busy for ever. Tuples
nested 500,000 deep as a key of a dictionary overflow the C stack when they are hashed, and tuples that hold the one
before twice take 2^depth steps. Python hashes an integer to its remainder by 2^61 - 1 and a frozenset to a mixture of
its members' hashes, so thousands of either can share one hash, and each new key is compared with all before it. A memo
index may ask for any amount of memory. So keys are no tuples, frozensets or integers beyond 64 bits (of those that are
left at most some dozens share a hash: texts have random ones), and indices are small.
"""

import pickle
import pickletools
from typing import Any

# Never written by the tools we read from, or able to reach beyond the allow-list; LONG4 holds numbers over 2^2000.
REFUSED_OPCODES = frozenset(
    {"PERSID", "BINPERSID", "EXT1", "EXT2", "EXT4", "INST", "OBJ", "NEXT_BUFFER", "READONLY_BUFFER"} | {"DUP", "LONG4"}
)
_MOST_OPCODES = 400_000  # about a second; numbers lie within few opcodes, a tensor takes about 50
_BYTES_PER_OPCODE = 8  # stored, of large files: one of 4,000 frames of 16 tensors each has 13 bytes per opcode
_PUT_OPCODES = {"PUT", "BINPUT", "LONG_BINPUT"}
_GET_OPCODES = {"GET", "BINGET", "LONG_BINGET"}
_TUPLES = {"TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_TUPLE"}
_INTEGERS = {"INT", "LONG", "LONG1"}
# What lies on the stack; the first three are refused as keys.
_TUPLE = "tuple"
_FROZENSET = "frozenset"
_LARGE = "number beyond 64 bits"
_OTHER = "other"
_REFUSED_KEYS = (_TUPLE, _FROZENSET, _LARGE)
_MARK = "mark"


class OpcodeLimit:
    """How many opcodes the pickles of one file may have together. n_stored: bytes of the file, compressed or not."""

    def __init__(self, n_stored: int) -> None:
        self.most = self.left = max(_MOST_OPCODES, n_stored // _BYTES_PER_OPCODE)

    def spend(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise pickle.UnpicklingError(f"it has more than {self.most} opcodes")


def check_opcodes(data: bytes, limit: OpcodeLimit | None = None) -> None:
    """Refuse opcodes we never need, memo indices beyond the file's length, and keys that take long to hash or compare.

    limit: of the file that ``data`` comes from; ``data`` is the whole file where it is not given.
    Raises UnpicklingError, or what pickletools raises on something that is no pickle.
    """
    walk, limit = _Walk(), limit or OpcodeLimit(len(data))
    for opcode, argument, _ in pickletools.genops(data):
        limit.spend()
        if opcode.name in REFUSED_OPCODES:
            raise pickle.UnpicklingError(f"it uses opcode {opcode.name}, which is not allowed")
        if opcode.name in _PUT_OPCODES and isinstance(argument, int) and argument > len(data):
            raise pickle.UnpicklingError(f"it stores memo entry {argument} in {len(data)} bytes")
        walk.step(opcode, argument)


class _Walk:
    """The stack of an unpickler with, in the place of each value, whether it is one that may be no key."""

    def __init__(self) -> None:
        self.stack: list[str] = []
        self.memo: dict[int, str] = {}

    def step(self, opcode: Any, argument: Any) -> None:
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
            self._replace(opcode, argument)

    def _replace(self, opcode: Any, argument: Any) -> None:
        """Take what an opcode takes, check the keys among it, and leave what it leaves."""
        taken = self._taken(opcode)
        for key in _hashed(opcode.name, taken):
            if key in _REFUSED_KEYS:
                raise pickle.UnpicklingError(f"a {key} as a key, which is not allowed")
        self.stack += [_kind(opcode.name, argument)] * len(opcode.stack_after)

    def _taken(self, opcode: Any) -> list[str]:
        wanted = opcode.stack_before
        if pickletools.markobject not in wanted:
            count = len(wanted)
        else:
            below = wanted.index(pickletools.markobject)
            count = below + len(self.stack) - self._last_mark()
        if count > len(self.stack):
            raise pickle.UnpicklingError("it takes more than there is")
        taken = self.stack[len(self.stack) - count :]
        del self.stack[len(self.stack) - count :]
        return taken

    def _last_mark(self) -> int:
        for place in range(len(self.stack) - 1, -1, -1):
            if self.stack[place] is _MARK:
                return place
        raise pickle.UnpicklingError("it takes all since a mark that is not there")

    def _top(self) -> str:
        if not self.stack:
            raise pickle.UnpicklingError("it takes more than there is")
        return self.stack[-1]


def _kind(name: str, argument: Any) -> str:
    """What an opcode leaves on the stack."""
    if name in _TUPLES:
        return _TUPLE
    if name == "FROZENSET":
        return _FROZENSET
    return _LARGE if name in _INTEGERS and is_large(argument) else _OTHER


def is_large(number: int) -> bool:
    """Whether an integer needs more than 64 bits."""
    return not -(2**63) <= number < 2**64


def _hashed(name: str, taken: list[str]) -> list[str]:
    """Which of the values an opcode takes become keys or members of a set."""
    if name == "SETITEM":
        return taken[1:2]
    if name in ("SETITEMS", "DICT"):
        return taken[taken.index(_MARK) + 1 :: 2]
    if name in ("ADDITEMS", "FROZENSET"):
        return taken[taken.index(_MARK) + 1 :]
    return []
