"""What a run does to its folder before it trains."""

from gsgan.train.run import remove_old_results


def test_starting_over_removes_an_earlier_runs_results_and_logs(tmp_path):
    for name in ("logs", "logs_000150"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.csv").write_text("step,val/psnr,val/seconds\n1,20,3\n")
    (tmp_path / "metrics.json").write_text("{}")
    (tmp_path / "notes.txt").write_text("mine")
    remove_old_results(tmp_path)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["notes.txt"]
