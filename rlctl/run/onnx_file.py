"""What an ONNX file may hold, looked at before a runtime runs it. Reads the file's own format; needs no `onnx`.

A graph without loops and branches ends by itself, and the runtime's memory has a limit. What a graph refers to must be
in its file. The numbers of the fields are those of https://github.com/onnx/onnx/blob/main/onnx/onnx.proto.
"""

from __future__ import annotations

from collections.abc import Iterator

_MODEL_GRAPH, _MODEL_TRAINING, _MODEL_FUNCTIONS = 7, 20, 25
_GRAPH_NODE, _GRAPH_TENSOR, _GRAPH_SPARSE = 1, 5, 15
_NODE_ATTRIBUTE = 5
_ATTRIBUTE_TENSORS, _ATTRIBUTE_GRAPHS, _ATTRIBUTE_SPARSE = (5, 10), (6, 11), (22, 23)
_TENSOR_ELSEWHERE = (13, 14)


def check(content: bytes) -> None:
    """Raise `ValueError` for a file with loops, branches or functions, or with tensors that are in other files."""
    for number, model in _fields(memoryview(content)):
        if number in (_MODEL_TRAINING, _MODEL_FUNCTIONS):
            raise ValueError("it has functions, which no policy needs")
        if number == _MODEL_GRAPH:
            _check_graph(_message(model))


def _check_graph(graph: memoryview) -> None:
    for number, part in _fields(graph):
        if number == _GRAPH_TENSOR:
            _check_tensor(_message(part))
        if number == _GRAPH_SPARSE:
            raise ValueError("it has sparse tensors, which no policy needs")
        if number == _GRAPH_NODE:
            for field, attribute in _fields(_message(part)):
                if field == _NODE_ATTRIBUTE:
                    _check_attribute(_message(attribute))


def _check_attribute(attribute: memoryview) -> None:
    for number, part in _fields(attribute):
        if number in _ATTRIBUTE_GRAPHS:
            raise ValueError("it has loops or branches, which no policy needs")
        if number in _ATTRIBUTE_SPARSE:
            raise ValueError("it has sparse tensors, which no policy needs")
        if number in _ATTRIBUTE_TENSORS:
            _check_tensor(_message(part))


def _check_tensor(tensor: memoryview) -> None:
    if any(number in _TENSOR_ELSEWHERE and part for number, part in _fields(tensor)):
        raise ValueError("a tensor of it is in another file")


def _message(part: memoryview | int) -> memoryview:
    if isinstance(part, int):
        raise ValueError("its fields are of other types than ONNX's")
    return part


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview | int]]:
    """Yield number and content of each field of a message in protobuf's format; of numbers their value."""
    place = 0
    while place < len(message):
        tag, place = _varint(message, place)
        number, kind = tag >> 3, tag & 7
        if kind == 0:
            value, place = _varint(message, place)
            yield number, value
            continue
        size = {1: 8, 5: 4}.get(kind)
        if kind == 2:
            size, place = _varint(message, place)
        if size is None or place + size > len(message):
            raise ValueError("cut off, or not ONNX")
        yield number, message[place : place + size]
        place += size


def _varint(message: memoryview, place: int) -> tuple[int, int]:
    """Return a number of variable length, and where it ends."""
    value = 0
    for shift in range(0, 70, 7):
        if place >= len(message):
            break
        byte = message[place]
        value, place = value | (byte & 0x7F) << shift, place + 1
        if byte < 0x80:
            return value, place
    raise ValueError("cut off, or not ONNX")
