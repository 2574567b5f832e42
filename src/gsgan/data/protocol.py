"""Published evaluation protocols: cameras, frames, region of the image, LPIPS.

Numbers of two protocols do not belong in one table; so a protocol has a name, is written beside
every score, and lists where a run departs from it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from gsgan.data.metric_variants import MetricVariants
from gsgan.utils.checks import between, positive
from gsgan.utils.errors import ConfigError


@dataclass(frozen=True)
class Protocol:
    """The training split, the held-out split, and the measures of a published evaluation.

    Args:
        name: of the protocol.
        train_cameras: names, or indices into the dataset's cameras as its reader orders them;
            None for all cameras that are not for tests.
        test_cameras: likewise; None for all cameras that are not for training.
        train_frames: "0-55", "0-495:5" (every fifth) or lists of such ranges; or all this by
            subject.
        test_frames: likewise.
        measures: the scored region of the images, and the variants of the metrics.
        scale: images are scored at this fraction of their stored size.
        lpips_net: the network of its LPIPS.
        source: of this definition.
        note: further remarks for readers of the numbers.
        subject: selects the frames, if they differ by subject.

    Raises:
        ConfigError: on a value out of range.
    """

    name: str
    train_frames: Any
    test_frames: Any
    train_cameras: Sequence[str | int] | None = None
    test_cameras: Sequence[str | int] | None = None
    measures: MetricVariants = field(default_factory=MetricVariants)
    scale: float = 1.0
    lpips_net: str = "vgg"
    source: str = ""
    note: str = ""
    subject: str | int | None = None

    def __post_init__(self) -> None:
        # Above 0 and at most 1.
        between("protocol.scale", positive("protocol.scale", self.scale), 0, 1)
        if self.train_cameras is None and self.test_cameras is None:
            raise ConfigError(
                "protocol.train_cameras and protocol.test_cameras are both null; name one of them"
            )

    def frames(self, side: Literal["train", "test"]) -> Any:
        """The frames of one side; if they differ by subject, the subject must be set."""
        frames = self.train_frames if side == "train" else self.test_frames
        if not isinstance(frames, Mapping):
            return frames
        # Keys of a config may be numbers.
        by_subject = {str(key): value for key, value in frames.items()}
        if str(self.subject) not in by_subject:
            raise ConfigError(
                f"protocol.subject is {self.subject}: the frames of {self.name} differ by "
                f"subject; give protocol.subject=, one of {', '.join(by_subject)}"
            )
        return by_subject[str(self.subject)]

    def record(self) -> dict[str, Any]:
        """The protocol as plain values, with the frames of the subject."""
        # The frames alone are kept of those that differ by subject.
        plain = asdict(self)
        plain["train_frames"] = self.frames("train")
        plain["test_frames"] = self.frames("test")
        # Lists, as JSON returns them.
        plain["measures"]["lpips_range"] = list(self.measures.lpips_range)
        for side in ("train_cameras", "test_cameras"):
            if plain[side] is not None:
                plain[side] = list(plain[side])
        return plain

    def departures(
        self,
        *,
        lpips_nets: Sequence[str],
        scales: Sequence[float] | None,
        padded: bool = False,
    ) -> Iterator[str]:
        """Departures of images and backbone from the protocol, one sentence each.

        Args:
            lpips_nets: the networks that LPIPS is computed with.
            scales: fractions of the stored sizes at which each camera's images are scored; None if
                they are cut around the person.
            padded: whole images are padded with black to squares.
        """
        # The backbone, then the size and form of the images.
        if self.lpips_net not in lpips_nets:
            yield f"LPIPS is not computed with {self.lpips_net}, as requested (lpips.nets)"
        if scales is None:
            yield "images are cut round the person, requested: whole images (data.crop=null)"
        for scale in sorted(set(scales or ())):
            if abs(scale - self.scale) > 1e-3:
                yield (
                    f"images are scored at scale {scale:.3g}, requested: {self.scale:g} "
                    "(data.size)"
                )
        if padded:
            yield "images are padded to squares with black, requested: as stored (data.size=null)"
