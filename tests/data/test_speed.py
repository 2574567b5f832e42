"""The loader's speed is measured on real decoding, and nothing is left changed."""

from __future__ import annotations

from pathlib import Path

import pytest
from make import write_tiny_capture

from gsgan.data import capture as reading
from gsgan.data.datamodule import GsganData
from gsgan.data.speed import LoaderSpeed, measure_loader


def test_every_frame_is_decoded_and_the_data_comes_back_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = GsganData(str(write_tiny_capture(tmp_path)), size=16, batch_size=2, steps_per_epoch=3)
    train = data.dataset("train")
    assert train[0] is not None
    limit = train.cache.limit
    decoded = []
    load = reading.CaptureDataset._load
    monkeypatch.setattr(
        reading.CaptureDataset,
        "_load",
        lambda self, item: decoded.append(item) or load(self, item),
    )
    speed = measure_loader(data, workers=0, batches=4, seconds=60)
    assert speed.frames == 8
    assert len(decoded) == 10  # and the first batch, which starts the clock
    assert (speed.workers, speed.size) == (0, (16, 16))
    assert speed.rate == pytest.approx(speed.frames / speed.seconds)
    assert (data.workers, data.steps_per_epoch, train.cache.limit) == (0, 3, limit)
    assert train.cache.nbytes == 0


def test_time_runs_out(tmp_path: Path) -> None:
    data = GsganData(str(write_tiny_capture(tmp_path)), size=16)
    assert measure_loader(data, workers=0, batches=10**6, seconds=1e-9).frames == 1


def test_rates() -> None:
    assert LoaderSpeed(80, 2.0, 4, (8, 8), 0.1).rate_per_worker == 10
    assert LoaderSpeed(80, 2.0, 0, (8, 8), 0.1).rate_per_worker == 40


@pytest.mark.parametrize("keys", [{"batches": 0}, {"seconds": 0}])
def test_nothing_cannot_be_measured(tmp_path: Path, keys: dict[str, int]) -> None:
    data = GsganData(str(write_tiny_capture(tmp_path)), size=16)
    with pytest.raises(ValueError, match="batches and seconds must be above 0"):
        measure_loader(data, 0, **keys)
