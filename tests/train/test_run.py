"""What a run does to its folder before it trains."""

from __future__ import annotations

from gsgan.train.run import remove_old_results


def test_starting_over_removes_an_earlier_runs_results_and_logs(tmp_path):
    for name in ("logs", "logs_000150"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.csv").write_text("step,val/psnr,val/seconds\n1,20,3\n")
    (tmp_path / "metrics.json").write_text("{}")
    (tmp_path / "notes.txt").write_text("mine")
    remove_old_results(tmp_path)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["notes.txt"]


def test_starting_over_leaves_what_is_not_a_runs_log(tmp_path):
    kept = ("logs/mine.txt", "logs_old/metrics.csv", "logs_000150/events.1")
    for name in (*kept, "logs/metrics.csv", "logs_000150/metrics.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("step\n")
    remove_old_results(tmp_path)
    left = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert left == set(kept)
