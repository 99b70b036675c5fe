"""Mutations of bytes: bits, cuts, splices, tokens, other numbers, repeated lines. Equal seeds give equal results."""

import random
import re
from collections.abc import Callable, Sequence

LONGEST = 1 << 14
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?")
NUMBERS = (
    *(b"0", b"-1", b"1", b"2", b"255", b"256", b"32768", b"65536", b"2147483647", b"2147483648", b"4294967295"),
    *(b"1000000000", b"9223372036854775807", b"9223372036854775808", b"18446744073709551616", b"1e5", b"1e308"),
    *(b"1e999", b"-1e999", b"nan", b"inf", b"-inf", b"NaN", b"1_0", b"0x10", b"1.5", b".5", b"--1", b"", b"9" * 5000),
)
INTEGERS = (0, 1, -1, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, 10**9)
Mutation = Callable[[random.Random, bytes, Sequence[bytes]], bytes]


def mutate(rng: random.Random, data: bytes, others: Sequence[bytes], tokens: Sequence[bytes]) -> bytes:
    """One to eight mutations of ``data``; others: further inputs to splice with; tokens: words of the format."""
    for _ in range(1 << rng.choice((0, 0, 0, 1, 1, 2, 3))):
        data = rng.choice(_MUTATIONS)(rng, data, tokens if rng.random() < 0.7 else others)
    return data if len(data) <= LONGEST else data[:LONGEST]


def _at(rng: random.Random, data: bytes) -> int:
    return rng.randrange(len(data) + 1)


def _span(rng: random.Random, data: bytes) -> tuple[int, int]:
    start = _at(rng, data)
    return start, min(len(data), start + 1 + int(rng.expovariate(1 / 8)))


def _flip_bit(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    if not data:
        return data
    at = rng.randrange(len(data))
    return data[:at] + bytes((data[at] ^ (1 << rng.randrange(8)),)) + data[at + 1 :]


def _other_byte(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    at = _at(rng, data)
    return data[:at] + bytes((rng.choice((0, 1, 9, 10, 32, 127, 128, 255, rng.randrange(256))),)) + data[at + 1 :]


def _cut_end(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    return data[: _at(rng, data)]


def _cut_span(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    start, stop = _span(rng, data)
    return data[:start] + data[stop:]


def _repeat_span(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    start, stop = _span(rng, data)
    return data[:stop] + data[start:stop] * rng.choice((1, 1, 2, 5, 50)) + data[stop:]


def _insert_word(rng: random.Random, data: bytes, words: Sequence[bytes]) -> bytes:
    at = _at(rng, data)
    return data[:at] + _word(rng, words) + data[at:]


def _overwrite_with_word(rng: random.Random, data: bytes, words: Sequence[bytes]) -> bytes:
    at, word = _at(rng, data), _word(rng, words)
    return data[:at] + word + data[at + len(word) :]


def _word(rng: random.Random, words: Sequence[bytes]) -> bytes:
    word = rng.choice(words) if words else b"\0"
    if len(word) <= 64:
        return word
    start = rng.randrange(len(word))
    return word[start : start + rng.randrange(256)]


def _other_integer(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    at, size = _at(rng, data), rng.choice((1, 2, 4, 8))
    value = rng.choice(INTEGERS) % (1 << 8 * size)
    return data[:at] + value.to_bytes(size, rng.choice(("little", "big"))) + data[at + size :]


def _other_number(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    start = _at(rng, data)
    found = NUMBER.search(data, start) or NUMBER.search(data)
    if found is None:
        return data
    new = rng.choice(NUMBERS) if rng.random() < 0.6 else str(rng.randrange(-3, 40)).encode()
    return data[: found.start()] + new + data[found.end() :]


def _other_line(rng: random.Random, data: bytes, _: Sequence[bytes]) -> bytes:
    lines = data.split(b"\n")
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(4):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, lines[other])
        case 2:
            lines[at], lines[other] = lines[other], lines[at]
        case _:
            lines[at] = b" ".join(lines[at].split()[:-1])
    return b"\n".join(lines)


_MUTATIONS: tuple[Mutation, ...] = (
    _flip_bit,
    _other_byte,
    _cut_end,
    _cut_span,
    _cut_span,
    _repeat_span,
    _insert_word,
    _insert_word,
    _overwrite_with_word,
    _other_integer,
    _other_number,
    _other_number,
    _other_line,
)
