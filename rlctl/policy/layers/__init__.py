"""The layers of a policy's actor: a file per kind, with its form in NumPy, ONNX and C."""

from rlctl.policy.layers.activation import ACTIVATIONS, Activation
from rlctl.policy.layers.batch_renorm import BatchRenorm
from rlctl.policy.layers.clip import Clip
from rlctl.policy.layers.convolution import Convolution, ScaleImage
from rlctl.policy.layers.flatten import Flatten
from rlctl.policy.layers.layer import Array, Layer, apply, as_row
from rlctl.policy.layers.linear import Linear
from rlctl.policy.layers.lstm import Lstm, LstmLayer
from rlctl.policy.layers.normalize import Normalize, standardize
from rlctl.policy.layers.one_hot import OneHot

__all__ = [
    "ACTIVATIONS",
    "Activation",
    "Array",
    "BatchRenorm",
    "Clip",
    "Convolution",
    "Flatten",
    "Layer",
    "Linear",
    "Lstm",
    "LstmLayer",
    "Normalize",
    "OneHot",
    "ScaleImage",
    "apply",
    "as_row",
    "standardize",
]
