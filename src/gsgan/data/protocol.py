"""Published evaluation protocols: which cameras and frames, which part of the picture, which LPIPS.

Numbers of two protocols do not belong in one table; so a protocol has a name, is written beside
every score, and says where a run departs from it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from gsgan.errors import ConfigError

# What gsgan.metrics computes, whatever the protocol asks for.
MEASURED: dict[str, Any] = {
    "region": "full picture",
    "background": "black",
    "lpips_region": "full picture",
    "lpips_range": (-1.0, 1.0),
    "ssim_range": 1.0,
}


@dataclass(frozen=True)
class Protocol:
    """Who trains, who tests, and what is measured.

    Args:
        name: of the protocol.
        train_cameras: names, or indices into the dataset's cameras as its reader orders them;
            None for all that do not test.
        test_cameras: the same; None for all that do not train.
        train_frames: "0-55", "0-495:5" (every fifth), lists of them; or such by subject.
        test_frames: the same.
        region: of the picture in which PSNR and SSIM are taken.
        background: "black" or "white".
        scale: pictures are scored at this share of their stored size.
        lpips_net: backbone.
        lpips_region: of the picture, for LPIPS.
        lpips_range: values that the backbone is fed, least and greatest.
        ssim_range: of the values, as SSIM is told.
        source: where this is written down.
        note: what else a reader of the numbers has to know.
        subject: whose frames, where they differ by subject.

    Raises:
        ConfigError: on a value out of range.
    """

    name: str
    train_frames: Any
    test_frames: Any
    train_cameras: Sequence[str | int] | None = None
    test_cameras: Sequence[str | int] | None = None
    region: str = "full picture"
    background: Literal["black", "white"] = "black"
    scale: float = 1.0
    lpips_net: str = "vgg"
    lpips_region: str = "full picture"
    lpips_range: tuple[float, float] = (-1.0, 1.0)
    ssim_range: float = 1.0
    source: str = ""
    note: str = ""
    subject: str | int | None = None

    def __post_init__(self) -> None:
        if not 0 < self.scale <= 1:
            raise ConfigError(f"protocol.scale must be in (0, 1], got {self.scale!r}")
        if self.background not in ("black", "white"):
            raise ConfigError(
                f"protocol.background must be black or white, got {self.background!r}"
            )
        if self.train_cameras is None and self.test_cameras is None:
            raise ConfigError(
                "protocol.train_cameras and protocol.test_cameras are both null; name one of them"
            )
        object.__setattr__(self, "lpips_range", tuple(map(float, self.lpips_range)))

    def frames(self, side: Literal["train", "test"]) -> Any:
        """The frames of one side, for the subject where they differ by subject.

        Raises:
            ConfigError: when they do, and the subject is not set or not known.
        """
        frames = self.train_frames if side == "train" else self.test_frames
        if not isinstance(frames, Mapping):
            return frames
        by_subject = {str(key): value for key, value in frames.items()}
        if str(self.subject) not in by_subject:
            raise ConfigError(
                f"protocol.subject is {self.subject}: the frames of {self.name} differ by "
                f"subject; give protocol.subject=, one of {', '.join(by_subject)}"
            )
        return by_subject[str(self.subject)]

    def record(self) -> dict[str, Any]:
        """All of it as plain values, frames as they are for the subject."""
        plain = asdict(self)
        plain["train_frames"], plain["test_frames"] = self.frames("train"), self.frames("test")
        plain["lpips_range"] = list(self.lpips_range)
        for side in ("train_cameras", "test_cameras"):
            plain[side] = None if plain[side] is None else list(plain[side])
        return plain

    def departures(
        self, *, lpips_net: str, scale: float | None, padded: bool = False
    ) -> Iterator[str]:
        """Where what is measured is not what the protocol asks for, one sentence each.

        Args:
            lpips_net: the backbone in use.
            scale: share of the stored size at which pictures are scored; None when they are cut
                round the person.
            padded: black is added to whole pictures to make them square.
        """
        for key, measured in MEASURED.items():
            asked = getattr(self, key)
            if asked != measured:
                yield f"{key.replace('_', ' ')} is {_said(measured)}, asked for: {_said(asked)}"
        if lpips_net != self.lpips_net:
            yield f"LPIPS backbone is {lpips_net}, asked for: {self.lpips_net}"
        if scale is None:
            yield "pictures are cut round the person, asked for: whole pictures (data.crop=null)"
        elif abs(scale - self.scale) > 1e-3:
            yield f"pictures are scored at scale {scale:.3g}, asked for: {self.scale:g} (data.size)"
        if padded:
            yield "pictures are padded to squares with black, asked for: as stored (data.size=null)"


def _said(value: Any) -> str:
    return " to ".join(f"{v:g}" for v in value) if isinstance(value, tuple) else str(value)
