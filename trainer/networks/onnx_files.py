"""An approximator as two ONNX files, which onnxruntime alone evaluates on the headset.

    approximator.onnx           irradiance (adapters, by default those exported) -> corrected
    approximator_gradient.onnx  irradiance, target, adapters -> loss, corrected, gradient, gradient.ADAPTER for each

The second file is the forward and the backward pass as one graph of plain operations. The network and torch's own
gradient of it are traced together into ATen operations, with decompositions for those that ONNX lacks, so network and
gradient always agree. Arrays are [1, C, H, W], C the bundle's colours and H, W the panel. Adapters are the last layer's
weights. They are inputs, so the headset refines them without a new export.
"""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import safetensors.torch
import torch
from torch import Tensor
from torch.nn import functional

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import ADAPTERS, APPROXIMATOR, GRADIENT
from trainer.networks.approximator import Approximator, amplitude

EXPORTED = ("published", "compact")
OPSET = 18

_aten = torch.ops.aten


class _Penalty(torch.autograd.Function):
    """`trainer.networks.approximator.penalty` with its gradient written out."""

    @staticmethod
    def forward(ctx: Any, corrected: Tensor, target: Tensor) -> Tensor:
        ours = amplitude(corrected)
        difference = ours - amplitude(target)
        ctx.save_for_backward(corrected, ours, difference)
        return _total(difference * difference, (3, 2, 1, 0))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        corrected, ours, difference = ctx.saved_tensors
        slope = difference / ours * gradients[0]
        return torch.where(corrected > 0, slope, torch.zeros_like(slope)), None


def _total(x: Tensor, axes: Sequence[int]) -> Tensor:
    """Sum over axes, last first, one at a time: onnxruntime adds millions of numbers in a row to three digits only."""
    for axis in axes:
        x = x.sum(axis)
    return x


def onnx_files(network: Approximator) -> dict[str, bytes]:
    """The files of an approximator, by name.

    Raises
    ------
    InputError
        For a network that has no export.
    """
    if network.architecture.network not in EXPORTED:
        raise InputError(
            f"the network '{network.architecture.network}' is a baseline and is not exported: train "
            f"{' or '.join(EXPORTED)} for the headset"
        )
    network = _frozen(network)
    shape = (1, network.architecture.planes, *network.architecture.shape)
    irradiance, target = torch.ones(shape), torch.ones(shape)
    adapters = {name: value.detach().clone() for name, value in network.adapters().items()}
    joint = _joint_gradient(network, tuple(adapters))
    arguments = (irradiance, target, *adapters.values())
    with _quiet():
        plain = _traced(_forward(network, tuple(adapters)), (irradiance, *adapters.values()))
        forward = onnx_bytes(
            plain, (irradiance, *adapters.values()), ["irradiance", *adapters], ["corrected"]
        )
        graph = _traced(joint, arguments)
        names = ["loss", "corrected", "gradient", *(f"gradient.{name}" for name in adapters)]
        gradient = onnx_bytes(graph, arguments, ["irradiance", "target", *adapters], names)
    return {
        APPROXIMATOR: _with_defaults(forward, adapters),
        GRADIENT: gradient,
        ADAPTERS: safetensors.torch.save(adapters),
    }


def _frozen(network: Approximator) -> Approximator:
    copy = Approximator(network.architecture)
    copy.load_state_dict(network.state_dict())
    return copy.requires_grad_(False).eval()


def _forward(network: Approximator, names: Sequence[str]) -> Callable[..., Tensor]:
    """(irradiance, adapters) to corrected."""

    def forward(irradiance: Tensor, *weights: Tensor) -> Tensor:
        corrected: Tensor = torch.func.functional_call(
            network, dict(zip(names, weights, strict=True)), (irradiance,)
        )
        return corrected

    return forward


def _with_defaults(model: bytes, values: Mapping[str, Tensor]) -> bytes:
    """A model whose inputs of these names have these values where none is given (ONNX IR: overridable initializers)."""
    import onnx

    made = onnx.load_from_string(model)
    made.graph.initializer.extend(
        onnx.numpy_helper.from_array(value.numpy(), name) for name, value in values.items()
    )
    whole: bytes = made.SerializeToString()
    return whole


def _joint_gradient(network: Approximator, names: Sequence[str]) -> Callable[..., tuple[Tensor, ...]]:
    """(irradiance, target, adapters) to (loss, corrected, gradient over irradiance, gradients over adapters)."""

    def joint(irradiance: Tensor, target: Tensor, *weights: Tensor) -> tuple[Tensor, ...]:
        x = irradiance.detach().requires_grad_(True)
        adapters = [w.detach().requires_grad_(True) for w in weights]
        with torch.enable_grad():
            corrected = torch.func.functional_call(network, dict(zip(names, adapters, strict=True)), (x,))
            loss = _Penalty.apply(corrected, target)
            return (loss, corrected.detach(), *torch.autograd.grad(loss, [x, *adapters]))

    return joint


def _traced(function: Callable[..., Any], arguments: tuple[Tensor, ...]) -> torch.fx.GraphModule:
    from torch.fx.experimental.proxy_tensor import make_fx

    graph = make_fx(function, decomposition_table=_decompositions(), tracing_mode="real")(*arguments)
    graph.graph.eliminate_dead_code()
    graph.recompile()
    return graph


def onnx_bytes(module: Any, arguments: tuple[Tensor, ...], inputs: list[str], outputs: list[str]) -> bytes:
    """A module as ONNX for arguments of these sizes."""
    program = torch.onnx.export(
        module,
        arguments,
        dynamo=True,
        input_names=inputs,
        output_names=outputs,
        opset_version=OPSET,
        verbose=False,
    )
    if program is None:  # only where the exporter writes a file itself, which is not asked for here
        raise RuntimeError("torch.onnx.export returned no program")
    buffer = io.BytesIO()
    import onnx

    onnx.save(program.model_proto, buffer)
    return buffer.getvalue()


@contextmanager
def _quiet() -> Any:
    """Without the exporter's warnings about its own internals."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def _decompositions() -> dict[Any, Callable[..., Any]]:
    """Decompositions of operations without a translation to ONNX; operations that have one are kept."""
    from torch._decomp import core_aten_decompositions

    table: dict[Any, Callable[..., Any]] = dict(core_aten_decompositions())
    table[_aten.convolution_backward.default] = _convolution_backward
    for kept in (_aten.leaky_relu.default, _aten.constant_pad_nd.default):
        table.pop(kept, None)
    return table


def _convolution_backward(
    gradient: Tensor,
    x: Tensor,
    weight: Tensor,
    bias_sizes: Any,
    stride: Sequence[int],
    padding: Sequence[int],
    dilation: Sequence[int],
    transposed: bool,
    output_padding: Sequence[int],
    groups: int,
    wanted: Sequence[bool],
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Adjoints of a convolution (dilation 1), as convolutions and matrix products.

    Over the input it is a transposed convolution (a plain one where the forward one is transposed); at stride 1 a plain
    one with the rotated kernel, which onnxruntime runs fastest. Over the weights it is one matrix product for each tap
    of the kernel.
    """
    over_x = over_weight = over_bias = None
    one, zero = [1, 1], [0, 0]
    if wanted[0] and transposed:
        over_x = _aten.convolution.default(gradient, weight, None, stride, padding, one, False, zero, groups)
    elif wanted[0] and all(s == 1 for s in stride):
        rotated = _swapped(weight, groups).flip(2, 3)
        edge = [weight.shape[2 + i] - 1 - padding[i] for i in (0, 1)]
        over_x = _aten.convolution.default(gradient, rotated, None, one, edge, one, False, zero, groups)
    elif wanted[0]:
        rest = [
            x.shape[2 + i] - ((gradient.shape[2 + i] - 1) * stride[i] - 2 * padding[i] + weight.shape[2 + i])
            for i in (0, 1)
        ]
        over_x = _aten.convolution.default(gradient, weight, None, stride, padding, one, True, rest, groups)
    if wanted[1]:
        wide, narrow = (gradient, x) if transposed else (x, gradient)
        over_weight = _over_weight(wide, narrow, weight, stride, padding, groups)
    if wanted[2]:
        over_bias = _total(gradient, (3, 2, 0))
    return over_x, over_weight, over_bias


def _swapped(weight: Tensor, groups: int) -> Tensor:
    """A kernel [out, in / groups, k, k] with in and out exchanged, group by group."""
    parts = [part.transpose(0, 1) for part in weight.chunk(groups)]
    return parts[0] if groups == 1 else torch.cat(parts)


def _over_weight(
    wide: Tensor, narrow: Tensor, weight: Tensor, stride: Sequence[int], padding: Sequence[int], groups: int
) -> Tensor:
    """Correlation of the side of the convolution before its stride with the one after it, [out, in / groups, k, k]."""
    rows, columns = weight.shape[2:]
    height, width = narrow.shape[2:]
    if tuple(stride) == (rows, columns) and not any(padding):
        return _over_patches(wide, narrow, weight, groups)
    padded = functional.pad(wide, (padding[1], padding[1] + stride[1], padding[0], padding[0] + stride[0]))
    taps = []
    for i in range(rows):
        for j in range(columns):
            window = padded[
                :,
                :,
                i : i + (height - 1) * stride[0] + 1 : stride[0],
                j : j + (width - 1) * stride[1] + 1 : stride[1],
            ]
            blocks = [
                torch.mm(_flat(a), _flat(b).t())
                for a, b in zip(narrow.chunk(groups, 1), window.chunk(groups, 1), strict=True)
            ]
            taps.append(torch.cat(blocks) if groups > 1 else blocks[0])
    return torch.stack(taps, -1).reshape(*taps[0].shape, rows, columns)


def _over_patches(wide: Tensor, narrow: Tensor, weight: Tensor, groups: int) -> Tensor:
    """`_over_weight` where the kernel's taps do not overlap: one matrix product for all of them.

    A convolution that picks out each tap is several times faster in onnxruntime than slicing or transposing.
    """
    channels, (rows, columns), size = wide.shape[1], weight.shape[2:], weight.shape[2] * weight.shape[3]
    picks = torch.eye(size, dtype=wide.dtype).reshape(size, 1, rows, columns).repeat(channels, 1, 1, 1)
    taps = _aten.convolution.default(
        wide, picks, None, [rows, columns], [0, 0], [1, 1], False, [0, 0], channels
    )
    blocks = [
        torch.mm(_flat(a), _flat(b).t())
        for a, b in zip(narrow.chunk(groups, 1), taps.chunk(groups, 1), strict=True)
    ]
    return torch.cat(blocks).reshape(narrow.shape[1], channels // groups, rows, columns)


def _flat(x: Tensor) -> Tensor:
    """[B, C, h, w] to [C, B h w]."""
    return x.permute(1, 0, 2, 3).reshape(x.shape[1], -1)
