"""Writing ULog, PX4's log format, so that pyulog, PlotJuggler and Flight Review read a run.

pyulog reads (and re-writes) ULog; nothing on PyPI writes it from scratch, so this
is a small writer after the file format's description in PX4's documentation
("ULog File Format"): a header, definitions (flag bits, formats, information,
parameters), then subscriptions and data in order of time.
"""

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

MAGIC = b"ULog\x01\x12\x35\x01"

# ULog's names of numpy's types.
_TYPE_NAMES = {
    "i1": "int8_t", "u1": "uint8_t", "i2": "int16_t", "u2": "uint16_t", "i4": "int32_t",
    "u4": "uint32_t", "i8": "int64_t", "u8": "uint64_t", "f4": "float", "f8": "double",
    "b1": "bool",
}  # fmt: skip


def write_ulog(
    path: Path,
    topics: Mapping[str, np.ndarray] | Mapping[str | tuple[str, int], np.ndarray],
    parameters: Mapping[str, int | float] | None = None,
    information: Mapping[str, str] | None = None,
) -> None:
    """Write a ULog file.

    Parameters
    ----------
    path : Path
        Of the file.
    topics : mapping
        Topic name, or (name, instance), to a structured array with one row a message;
        its first field is `timestamp` (uint64, us). Sub-arrays become ULog arrays.
    parameters : mapping, optional
        Parameter name to value: an int is written as int32, a float as float.
    information : mapping, optional
        Information messages, text only.

    Raises
    ------
    ValueError
        If an array has no leading `timestamp` of type uint64 or a type ULog lacks.
    """
    keyed = {(key, 0) if isinstance(key, str) else key: rows for key, rows in topics.items()}
    for (name, _), rows in keyed.items():
        if not rows.dtype.names or rows.dtype.names[0] != "timestamp":
            raise ValueError(f"topic {name}: the first field must be timestamp")
    starts = [int(rows["timestamp"][0]) for rows in keyed.values() if len(rows)]
    chunks = [MAGIC, struct.pack("<Q", min(starts, default=0))]
    chunks.append(_message("B", bytes(40)))
    for name in dict.fromkeys(name for name, _ in keyed):
        rows = next(rows for (other, _), rows in keyed.items() if other == name)
        chunks.append(_message("F", f"{name}:{_format(rows.dtype)}".encode()))
    for key, text in (information or {}).items():
        value = text.encode()
        chunks.append(_message("I", _key(f"char[{len(value)}] {key}") + value))
    for key, number in (parameters or {}).items():
        if isinstance(number, (int, np.integer)):
            chunks.append(_message("P", _key(f"int32_t {key}") + struct.pack("<i", int(number))))
        else:
            chunks.append(_message("P", _key(f"float {key}") + struct.pack("<f", float(number))))
    for message_id, (name, instance) in enumerate(keyed):
        chunks.append(_message("A", struct.pack("<BH", instance, message_id) + name.encode()))
    chunks += _data(list(keyed.values()))
    path.write_bytes(b"".join(chunks))


def _data(topics: list[np.ndarray]) -> list[bytes]:
    """All data messages in order of time; messages of one time in the order of topics."""
    messages: list[bytes] = []
    stamps: list[np.ndarray] = []
    for message_id, rows in enumerate(topics):
        packed = np.ascontiguousarray(rows, dtype=_packed(rows.dtype))
        size = packed.dtype.itemsize
        header = struct.pack("<HcH", size + 2, b"D", message_id)
        body = packed.tobytes()
        messages += [header + body[i * size : (i + 1) * size] for i in range(len(packed))]
        stamps.append(packed["timestamp"])
    if not stamps:
        return messages
    return [messages[i] for i in np.argsort(np.concatenate(stamps), kind="stable")]


def _packed(dtype: np.dtype) -> np.dtype:
    """The same fields, little-endian and without padding."""
    return np.dtype([(name, dtype[name].newbyteorder("<")) for name in dtype.names or ()])


def _format(dtype: np.dtype) -> str:
    fields = []
    for name in dtype.names or ():
        base, shape = dtype[name].base, dtype[name].shape
        code = "b1" if base.kind == "b" else f"{base.kind}{base.itemsize}"
        if code not in _TYPE_NAMES or len(shape) > 1:
            raise ValueError(f"field {name}: ULog has no type for {dtype[name]}")
        count = f"[{shape[0]}]" if shape else ""
        fields.append(f"{_TYPE_NAMES[code]}{count} {name};")
    return "".join(fields)


def _key(text: str) -> bytes:
    encoded = text.encode()
    return struct.pack("<B", len(encoded)) + encoded


def _message(kind: str, payload: bytes) -> bytes:
    return struct.pack("<Hc", len(payload), kind.encode()) + payload
