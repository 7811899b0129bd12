import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_detection import DatasetError
from vehicle_detection.training import RowStore, make_table, pareto_front, read_results, write_results
from vehicle_detection.training.tuning import COLUMNS


def example_row(number):
    return {
        **dict.fromkeys(COLUMNS), "status": "ok", "message": 'a "quoted", text; ä', "configuration": "007",
        "hog_channel": ["ALL", 0][number % 2], "mirror": True, "C": 1e-4 / (number + 1),
        "accuracy": 1 / (number + 3), "seed": number, "trial": f"{number:04d}e{number}",
    }  # fmt: skip


def example_table(count):
    return make_table([example_row(number) for number in range(count)], COLUMNS)


# The store


@settings(max_examples=40)
@given(cut=st.integers(0, 10**6), count=st.integers(0, 5))
def test_a_file_cut_anywhere_keeps_its_complete_lines(tmp_path_factory, cut, count):
    path = tmp_path_factory.mktemp("cut") / "rows.jsonl"
    store = RowStore(path, COLUMNS)
    for number in range(count):
        store.add(example_row(number))
    data = path.read_bytes() if count else b""
    path.write_bytes(data[: cut % (len(data) + 1)])
    n_complete = path.read_bytes().count(b"\n")
    again = RowStore(path, COLUMNS)
    kept = [number for number in range(count) if f"{number:04d}e{number}" in again]
    assert kept == list(range(n_complete))
    for number in range(len(kept), count + 1):
        again.add(example_row(number))
    pd.testing.assert_frame_equal(read_results(path), example_table(count + 1))


def test_a_trial_that_two_runs_measure_is_one_row(tmp_path):
    path = tmp_path / "rows.jsonl"
    for store in (RowStore(path, COLUMNS), RowStore(path, COLUMNS)):
        for number in range(2):
            store.add(example_row(number))
    pd.testing.assert_frame_equal(read_results(path), example_table(2))


@pytest.mark.parametrize("text", ["my only notes", '{"a": 1}', '{"a": 1}\n', "[1]"])
def test_files_of_others_are_kept(text, tmp_path):
    path = tmp_path / "a.jsonl"
    path.write_text(text)
    with pytest.raises(DatasetError, match="is not a table of trials, or of another release; choose another"):
        RowStore(path, COLUMNS)
    assert path.read_text() == text


def test_damaged_files(tmp_path):
    path = tmp_path / "rows.jsonl"
    RowStore(path, COLUMNS).add(example_row(0))
    for line in (b"[1]\n", b"\xff\xfe\n"):
        path.write_bytes(path.read_bytes()[: path.read_bytes().index(b"\n") + 1] + line)
        with pytest.raises(DatasetError, match=r"rows.jsonl is damaged in line 2; delete that line"):
            RowStore(path, COLUMNS)
    table = tmp_path / "rows.csv"
    for content in (b"", b"a,b\n1,2\n1,2,3\n", b"\xff\xfe\n"):
        table.write_bytes(content)
        with pytest.raises(DatasetError, match=r"rows.csv is not a table"):
            read_results(table)


# Tables


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
@pytest.mark.parametrize("count", [0, 4])
def test_a_table_reads_as_it_was_written(tmp_path, suffix, count):
    path = tmp_path / f"table{suffix}"
    table = example_table(count).assign(hog_channel="ALL", configuration="ä")
    write_results(table, path)
    read = read_results(path)
    assert path.read_text(encoding="utf-8").count("\n") == count + (suffix == ".csv")
    if count:
        pd.testing.assert_frame_equal(read, table)
    else:
        assert len(read) == 0


def test_a_table_as_parquet(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    table = example_table(4)
    write_results(table, tmp_path / "table.parquet")
    read = parquet.read_table(tmp_path / "table.parquet").to_pylist()
    assert list(read[0]) == list(COLUMNS)
    assert [row["accuracy"] for row in read] == table["accuracy"].tolist()
    assert [row["hog_channel"] for row in read] == ["ALL", "0", "ALL", "0"]


points = st.lists(st.tuples(st.none() | st.integers(0, 5), st.none() | st.integers(0, 5)), max_size=12).map(
    lambda pairs: make_table(
        [{"accuracy": quality, "search_ms": cost} for quality, cost in pairs], ["accuracy", "search_ms"]
    )
)


@given(table=points)
def test_no_row_beats_the_pareto_front(table):
    measured = list(table.dropna().itertuples(index=False, name=None))
    front = list(pareto_front(table).itertuples(index=False, name=None))
    assert sorted(front) == front
    for quality, cost in measured:
        beaten = any((q >= quality and c < cost) or (q > quality and c <= cost) for q, c in measured)
        assert ((quality, cost) in front) == (not beaten)
    assert len(set(front)) == len(front)
