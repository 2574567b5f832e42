"""Hard inputs of the generator: empty pixels, unbounded features, half precision."""

from collections.abc import Iterator
from functools import lru_cache, partial

import torch
from torch import Tensor, nn

from gsgan.model.generator import Generator, StyleModulation
from stability.cases.case import Case, Inputs, Outputs, Tolerance

SIDE = 16  # pixels
CHANNELS = {"F": 5, "S": 4, "p2d": 8}
POSE = 35
TIMES = 2  # F is drawn so many times larger each way, and averaged


def cases() -> Iterator[Case]:
    """All of them."""
    half_empty, empty = (
        partial(_inputs, person=0.5),
        partial(_inputs, person=0.0),
    )
    huge, large = (
        partial(_inputs, scale=1e9),
        partial(_inputs, scale=1e6, shift=0.5),
    )
    unbiased = partial(_painted, biased=False)
    clamped = "F is clamped to ± 1e3 before it enters; beyond, its slope is 0."
    zero = "Normalising a pixel that is zero in every channel: it stays zero."
    steep = "The slope is 1e3 per normalisation, so 1e15 in all: this is why there are biases."
    for name, make, run, note in (
        ("an ordinary image", _inputs, _painted, ""),
        ("half of the pixels all zero", half_empty, _painted, ""),
        ("every pixel zero", empty, _painted, ""),
        ("half of the pixels all zero, no biases", half_empty, unbiased, zero),
        ("every pixel zero, no biases", empty, unbiased, steep),
        ("features of 1e9", huge, _painted, clamped),
        ("features of ± 1e6", large, _painted, clamped),
        ("features of 1e-6", partial(_inputs, scale=1e-6), _painted, ""),
    ):
        yield Case("generator", name, make, run, note=note)
    note = "The image only: half precision's gradients belong to a network whose activations near "
    for half, dtype, within in (
        ("bf16", torch.bfloat16, 0.05),
        ("fp16", torch.float16, 0.02),
    ):
        for name, make in (
            ("an ordinary image", _inputs),
            ("half of the pixels all zero", half_empty),
            ("features of 1e9", huge),
            ("features of ± 1e6", large),
        ):
            yield Case(
                "generator",
                f"{half} autocast, {name}",
                make,
                partial(_in_half_precision, half=dtype),
                tolerance=Tolerance(within),
                note=note + "0 have the other sign.",
            )


@lru_cache(maxsize=8)
def _generator(
    dtype: torch.dtype, device: torch.device, biased: bool
) -> Generator:
    """A small one whose style is not at its start, with or without biases."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        F, S, p2d = CHANNELS.values()
        made = Generator(F, S, p2d, POSE, TIMES, base=4)
        for module in made.modules():
            if (
                isinstance(module, StyleModulation)
                and module.from_map is not None
            ):
                nn.init.normal_(module.from_map.weight, std=0.1)
                nn.init.normal_(module.from_pose.weight, std=0.1)
    if not biased:
        for name, parameter in made.named_parameters():
            if name.endswith("bias"):
                nn.init.zeros_(parameter)
    return made.to(device, dtype)


def _inputs(
    scale: float = 1.0, shift: float = 0.0, person: float = 1.0
) -> Inputs:
    """Random maps; beyond ``person`` of the width every channel is zero."""
    generator = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> Tensor:
        return torch.rand(1, *shape, generator=generator, dtype=torch.float64)

    made = {
        name: rand(channels, SIDE, SIDE) for name, channels in CHANNELS.items()
    }
    made["fine"] = rand(CHANNELS["F"], TIMES * SIDE, TIMES * SIDE)
    for name in ("F", "fine"):
        made[name] = scale * (made[name] - shift)
    for value in made.values():
        value[..., round(person * value.shape[-1]) :] = 0
    return {**made, "g": 2 * rand(POSE) - 1}


def _painted(inputs: Inputs, biased: bool = True) -> Outputs:
    F, S, p2d, g, fine = (
        inputs[name] for name in ("F", "S", "p2d", "g", "fine")
    )
    generator = _generator(F.dtype, F.device, biased)
    # the avatar bounds what is splatted, see Avatar.bounded
    bound = generator.feature_bound
    F, fine = F.clamp(-bound, bound), fine.clamp(-bound, bound)
    return {"image": generator(F, S, p2d, g, fine)}


def _in_half_precision(inputs: Inputs, half: torch.dtype) -> Outputs:
    """Under autocast, which float64 is not subject to.

    The image only. Rounding flips activations that are near 0, so the gradient is right for a
    slightly different network: off by 0.1 of its largest entry and more, whatever the code does.
    """
    with torch.no_grad(), torch.autocast(inputs["F"].device.type, dtype=half):
        return {"image": _painted(inputs)["image"].to(inputs["F"].dtype)}
