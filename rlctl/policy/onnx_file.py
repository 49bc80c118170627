"""ONNX files of rlctl: written with a sha256, and checked before onnxruntime reads them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rlctl.storage import files

if TYPE_CHECKING:
    import onnx

METADATA_KEY = "rlctl"  # metadata key of the policy's description
DIGEST_KEY = "sha256"  # metadata key of the sha256 of the file's bytes, computed with zeros in place of the digest

_ZEROS = b"0" * 64


def encode(model: onnx.ModelProto) -> bytes:
    """Return the bytes of a model, with their sha256 in its metadata."""
    for index, entry in enumerate(model.metadata_props):
        if entry.key == DIGEST_KEY:
            del model.metadata_props[index]
            break
    entry = model.metadata_props.add()
    entry.key, entry.value = DIGEST_KEY, _ZEROS.decode()
    content: bytes = model.SerializeToString()
    if content.count(_ZEROS) != 1:
        raise ValueError("its bytes contain the text of 64 zeros, which marks the place of the sha256")
    return content.replace(_ZEROS, files.digest(content).encode())


def check(content: bytes) -> None:
    """Raise `ValueError` for a file that is damaged, or that has more than a policy needs.

    Loops, branches and functions may never end; a tensor in another file would read a path that the sender chose.
    """
    import onnx
    from google.protobuf.message import DecodeError

    try:
        model = onnx.ModelProto.FromString(content)
    except DecodeError:
        raise ValueError("cut off, or not ONNX") from None
    if model.functions or model.training_info:
        raise ValueError("it has functions, which no policy needs")
    attributes = [attribute for node in model.graph.node for attribute in node.attribute]
    if any(attribute.graphs or attribute.HasField("g") for attribute in attributes):
        raise ValueError("it has loops or branches, which no policy needs")
    if model.graph.sparse_initializer or any(
        attribute.sparse_tensors or attribute.HasField("sparse_tensor") for attribute in attributes
    ):
        raise ValueError("it has sparse tensors, which no policy needs")
    inside = [tensor for attribute in attributes for tensor in (attribute.t, *attribute.tensors)]
    for tensor in (*model.graph.initializer, *inside):
        if tensor.external_data or tensor.data_location != onnx.TensorProto.DEFAULT:
            raise ValueError("one of its tensors is in another file")
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    if METADATA_KEY in metadata:
        _check_digest(content, metadata.get(DIGEST_KEY, ""))


def _check_digest(content: bytes, digest: str) -> None:
    if not digest:
        raise ValueError("its metadata has no sha256; rlctl writes one into every export; export it again")
    digest = str(digest)  # protobuf returns bytes for damaged text
    if files.digest(content.replace(digest.encode(), _ZEROS)) != digest:
        raise ValueError("its content does not match its sha256")
