"""A log that is still being written: its sound part is read, or it is refused in one line."""

import io
import itertools
import threading
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
from binary_logs import write_mcap

from bampipe.data.readers import columns_of, read_trial
from bampipe.errors import InputError

ROWS = 300
TABLE = {"t": np.arange(ROWS) / 64.0, "x": np.arange(ROWS) * 0.25 + 1000.125}


class Growing(io.FileIO):
    """A file to which a row is added whenever its size is asked for."""

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        place = super().seek(offset, whence)
        if whence == io.SEEK_END:
            with open(self.name, "ab") as stream:
                stream.write(b"9.000000,9.000000\n")
        return place


def as_hdf5(stream: io.BytesIO) -> None:
    with h5py.File(stream, "w") as file:
        for name, values in TABLE.items():
            file[name] = values


def as_tdms(stream: io.BytesIO) -> None:
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(stream) as writer:
        for part in np.array_split(np.arange(ROWS), 5):
            writer.write_segment([nptdms.ChannelObject("g", c, v[part]) for c, v in TABLE.items()])


def as_mcap(stream: io.BytesIO) -> None:
    messages = ((n * 15_625_000, b'{"x": %.3f}' % TABLE["x"][n]) for n in range(ROWS))
    write_mcap(stream, "/g", messages, chunk_size=1000)


def binary(write: Callable[[io.BytesIO], object]) -> bytes:
    stream = io.BytesIO()
    write(stream)
    return stream.getvalue()


FRAME = pd.DataFrame(TABLE)
LOGS: dict[str, tuple[Callable[[], bytes], tuple[str, str]]] = {
    ".csv": (lambda: FRAME.to_csv(index=False, float_format="%.6f").encode(), ("t", "x")),
    ".jsonl": (lambda: FRAME.to_json(orient="records", lines=True).encode(), ("t", "x")),
    ".json": (lambda: FRAME.to_json(orient="records").encode(), ("t", "x")),
    ".parquet": (lambda: binary(FRAME.to_parquet), ("t", "x")),
    ".mat": (lambda: binary(lambda s: scipy.io.savemat(s, TABLE)), ("t", "x")),
    ".h5": (lambda: binary(as_hdf5), ("t", "x")),
    ".tdms": (lambda: binary(as_tdms), ("g/t", "g/x")),
    ".mcap": (lambda: binary(as_mcap), ("/g:@time", "/g:x")),
}  # fmt: skip


@pytest.mark.parametrize("ending", LOGS)
def test_a_log_read_while_it_grows(
    ending: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write, columns = LOGS[ending]
    content, path = write(), tmp_path / f"a{ending}"
    cuts = np.linspace(0, len(content), 120).astype(int)
    started, refused, lengths = threading.Event(), [], []

    def log() -> None:
        with path.open("wb", buffering=0) as stream:
            for first, last in itertools.pairwise(cuts):
                stream.write(content[first:last])
                started.set()
                threading.Event().wait(0.002)

    def look() -> None:
        try:
            columns_of(path, name="log")
            trial = read_trial(path, columns, name="log")
        except InputError as error:
            refused.append(str(error))
            return
        time, x = (trial.columns[column] for column in columns)
        lengths.append(len(time))
        np.testing.assert_allclose(time, TABLE["t"][: len(time)], atol=1e-6)
        np.testing.assert_allclose(x, TABLE["x"][: len(time)], atol=1e-6)

    writer = threading.Thread(target=log)
    writer.start()
    started.wait()
    while writer.is_alive():
        look()
    writer.join()
    for cut in cuts[1:-1:7]:
        path.write_bytes(content[:cut])
        look()
    path.write_bytes(content)
    look()
    assert lengths[-1] == ROWS
    assert ending not in (".csv", ".jsonl") or len(lengths) > 20  # what is there is read
    assert all("\n" not in line and line.startswith("log") for line in refused), refused
    assert capfd.readouterr() == ("", "")


def test_what_is_written_while_the_end_is_looked_for_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b"t,x\n1.000000,1.000000\n2.000000,2.00")
    usual = Path.open
    monkeypatch.setattr(
        Path, "open", lambda self, *a, **k: (Growing if self == path else usual)(self, *a, **k)
    )
    trial = read_trial(path, ("t", "x"), name="log")
    assert trial.columns["x"].tolist() == [1.0]
    assert trial.notes == ("last line is cut off: 1 row dropped",)
