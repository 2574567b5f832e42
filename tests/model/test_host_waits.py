"""Painting never makes the host wait for a GPU, so that it can be captured as a graph.

On the meta device every operation that reads a number back fails. What would be copied over from
the host (a tensor made of numbers) is counted beside it. The rasteriser itself is stood in for:
gsplat's is not ours, and the portable one waits twice, see `gsgan.splat.tile_lists`.
"""

from collections import Counter
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from gsgan.splat import gsplat_backend, native

META = torch.device("meta")
READS = (
    "_local_scalar_dense",
    "nonzero",
    "masked_select",
    "unique",
    "is_nonzero",
    "equal",
)


class Reads(TorchDispatchMode):
    """Counts operators for which the host waits."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: Counter[str] = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        if any(name.startswith(read) for read in READS):
            self.seen[name] += 1
        if (
            name == "lift_fresh"
        ):  # an index that is a list, or a tensor made of numbers
            self.seen["a copy of numbers"] += 1
        if (
            name == "repeat_interleave"
            and (kwargs or {}).get("output_size") is None
        ):
            self.seen[name] += 1
        if name.startswith("index") and any(
            isinstance(i, torch.Tensor) and i.dtype == torch.bool
            for i in (args[1] if isinstance(args[1], list | tuple) else ())
        ):
            self.seen["index by a mask"] += 1
        return func(*args, **(kwargs or {}))


class OnDevice(Reads):
    """The same of operators on `META` alone."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        flat = torch.utils._pytree.tree_leaves((args, kwargs))
        if any(isinstance(x, torch.Tensor) and x.device == META for x in flat):
            return super().__torch_dispatch__(func, types, args, kwargs)
        return func(*args, **(kwargs or {}))


@pytest.fixture
def copies(monkeypatch):
    """Counts tensors that are made of numbers on a device."""
    seen: Counter[str] = Counter()

    def counted(module, name, device_of):
        plain = getattr(module, name)

        def make(*args, **kwargs):
            if device_of(args, kwargs) == META:
                seen[name] += 1
            return plain(*args, **kwargs)

        monkeypatch.setattr(module, name, make)

    def asked(args, kwargs):
        return torch.device(kwargs.get("device") or "cpu")

    counted(torch, "tensor", asked)
    counted(torch, "as_tensor", asked)
    counted(torch.Tensor, "new_tensor", lambda args, kwargs: args[0].device)
    return seen


def drawn(gaussians, camera, settings):
    """What gsplat would return, empty."""
    batch, (height, width) = len(camera), camera.size
    features = gaussians.features.new_zeros(
        batch, gaussians.features.shape[-1], height, width
    )
    return features, features[:, :1]


def on_meta(avatar, monkeypatch):
    """The avatar as on a GPU, whose rasteriser is stood in for."""
    monkeypatch.setattr(gsplat_backend, "why_not", lambda settings, device: "")
    monkeypatch.setattr(gsplat_backend, "draw", drawn)
    # knows no meta device
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    avatar = avatar.to(META).eval()
    avatar.backend = "gsplat"
    if avatar.segmentation is not None:
        avatar.segmentation.backend = "gsplat"
    return avatar


@pytest.mark.parametrize(
    ("model", "scene"),
    [
        ("full", "all"),
        ("full", "lens"),
        ("wo_gcn", "none"),
        ("splat_only", "auto"),
        ("lbs_splat", "all"),
        ("image_to_image", "auto"),
    ],
)
def test_painting_reads_nothing_back_and_copies_nothing_over(
    build, monkeypatch, copies, model, scene
):
    effects = "auto" if scene == "lens" else scene
    _, avatar, frame = build(f"model={model}", f"effects={effects}")
    if scene == "lens":
        dist = torch.tensor([[-0.2, 0.05, 0.001, 0.0, 0.0]])
        frame = replace(frame, camera=replace(frame.camera, dist=dist))
    window = avatar.window(frame.skeleton, frame.camera)
    assert window is not None
    frame = window.frame(frame).to(META)
    avatar = on_meta(avatar, monkeypatch)

    def paint():
        with torch.no_grad():
            return avatar(*frame.inputs).paste(window)

    paint()  # constants are made once for a device
    copies.clear()
    with Reads() as reads:
        painting = paint()
    assert painting.image.device == META
    assert painting.image.shape[-2:] == window.whole
    assert not reads.seen
    assert not copies


@pytest.mark.skipif(not native.available(), reason=native.why_not())
@pytest.mark.parametrize("model", ["full", "lbs_splat"])
def test_a_bare_skeleton_is_solved_on_the_host_and_reads_nothing_back(
    build, monkeypatch, copies, model
):
    """Of avatars on a body."""
    _, avatar, frame = build(f"model={model}", "effects=all")
    assert avatar.needs_body
    skeleton = frame.skeleton[0]
    with torch.no_grad():
        # its constants lie on the host
        avatar.solver.solve(frame.skeleton, frame.visibility)
    avatar = on_meta(avatar, monkeypatch)
    avatar.render(skeleton, frame.camera)
    copies.clear()
    with OnDevice() as reads:
        image = avatar.render(skeleton, frame.camera)
    assert image.device == META
    assert image.shape[-2:] == frame.camera.size
    assert not reads.seen
    assert not copies


def test_the_window_is_read_back_once(build, monkeypatch):
    _, avatar, frame = build()
    lists, plain = [], torch.Tensor.tolist
    monkeypatch.setattr(
        torch.Tensor, "tolist", lambda x: lists.append(x) or plain(x)
    )
    with Reads() as reads:
        avatar.window(frame.skeleton, frame.camera)
    assert len(lists) == 1
    assert not reads.seen
