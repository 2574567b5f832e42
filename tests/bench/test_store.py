"""An interrupted bench goes on; figures of other settings or other code are not taken."""

from __future__ import annotations

from gsgan.bench.store import Store, source_digest

KEY = {"n": 1}


def test_what_was_put_is_found_by_the_next_process(tmp_path):
    path = tmp_path / "deep" / "m.jsonl"
    Store(path).put(KEY, {"repeats": 7}, [{"ms": 1.5}])
    assert Store(path).get(KEY, {"repeats": 7}) == [{"ms": 1.5}]
    assert Store(path).get({"n": 2}, {"repeats": 7}) is None


def test_other_conditions_are_another_measurement_and_the_last_one_counts(tmp_path):
    store = Store(tmp_path / "m.jsonl")
    store.put(KEY, {"repeats": 7}, "old")
    assert store.get(KEY, {"repeats": 9}) is None
    store.put(KEY, {"repeats": 9}, "new")
    for found in (store, Store(store.path)):
        assert found.get(KEY, {"repeats": 9}) == "new"
        assert found.get(KEY, {"repeats": 7}) is None


def test_a_line_cut_short_is_passed_over_and_does_not_swallow_the_next(tmp_path):
    store = Store(tmp_path / "m.jsonl")
    store.put(KEY, {}, "whole")
    store.put({"n": 2}, {}, "cut")
    store.path.write_bytes(store.path.read_bytes()[:-9])
    store = Store(store.path)
    assert store.get(KEY, {}) == "whole"
    assert store.get({"n": 2}, {}) is None
    store.put({"n": 3}, {}, "after")
    assert Store(store.path).get({"n": 3}, {}) == "after"


def test_what_is_no_record_is_passed_over(tmp_path):
    path = tmp_path / "m.jsonl"
    path.write_text('3\n{"key": 1}\n\nnonsense\n')
    Store(path).put(KEY, {}, "here")
    assert Store(path).get(KEY, {}) == "here"


def test_fresh_forgets(tmp_path):
    path = tmp_path / "m.jsonl"
    Store(path).put(KEY, {}, 1)
    assert Store(path, fresh=True).get(KEY, {}) is None
    assert not path.exists()


def test_the_code_has_a_name(tmp_path):
    one, two = tmp_path / "a.py", tmp_path / "b.py"
    one.write_text("x = 1")
    two.write_text("y = 2")
    before = source_digest([one, two])
    assert source_digest([two, one]) == before
    two.write_text("y = 3")
    assert source_digest([one, two]) != before
