"""Lines that come in pieces, and lines that are wrong."""

import os
from pathlib import Path

import numpy as np
import pytest

from bampipe.data.quality.channels import to_si
from bampipe.data.quality.table import CleaningLimits, TrialTable
from bampipe.data.readers.trial import RawTrial
from bampipe.data.session import read_session, session_from
from bampipe.data.session.conversion import Conversion
from bampipe.data.stream import SampleStream, conversion_of_stream
from bampipe.errors import InputError

SAMPLES = Path(__file__).parents[2] / "sample_runs"
SI = Conversion.in_si(["q_yaw", "force_x"])


class Pipe:
    """A pipe with a stream at its end."""

    def __init__(self, layouts=(SI,), strict=False):
        self.source, sink = os.pipe()
        os.set_blocking(self.source, False)
        self._sink = os.fdopen(sink, "wb", buffering=0)
        self.said = []
        self.stream = SampleStream(self.source, "log", layouts, strict, self.said.append)

    def write(self, text):
        """Send text; return what the stream makes of it."""
        self._sink.write(text.encode() if isinstance(text, str) else text)
        return self.stream.read()

    def close(self):
        """Send no more; return what the stream makes of the rest."""
        self._sink.close()
        return self.stream.read(last=True)


def test_lines_come_in_pieces():
    pipe = Pipe()
    assert pipe.write("\ufeff# logger 3\nforce_x, t,").shape == (0, 0)
    assert pipe.write(" note, q_yaw\n1.5,0.0").shape == (0, 3)
    assert pipe.stream.names == ("t", "q_yaw", "force_x")
    np.testing.assert_array_equal(pipe.write(",a,0.25\n2.5,"), [[0.0, 0.25, 1.5]])
    np.testing.assert_array_equal(pipe.write("0.1,b,0.5\r\n\n3.5"), [[0.1, 0.5, 2.5]])
    pipe.write(",0.2,c,")
    np.testing.assert_array_equal(pipe.close(), [[0.2, np.nan, 3.5]])
    assert pipe.stream.ended
    assert pipe.stream.bad_lines == 0


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_other_delimiters(delimiter):
    pipe = Pipe()
    rows = pipe.write("t,q_yaw,force_x\n1,2,3\n".replace(",", delimiter))
    np.testing.assert_array_equal(rows, [[1.0, 2.0, 3.0]])


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("0.1,abc,1", "line 3, column q_yaw: 'abc' is no number"),
        ("0.1,1", "line 3: 2 cells where the header has 3"),
        ("0.1,1,", "line 3, column force_x: '' is no number"),
        ("0.1,1,inf", "line 3, column force_x: 'inf' is no number"),
        ("0.0,1,1", "line 3, column t: the time does not increase"),
        ("nan,1,1", "line 3, column t: 'nan' is no number"),
        ("0.1,inf,1", "line 3, column q_yaw: 'inf' is no number"),
        ("0.1,1e308,1", "line 3: q_yaw is larger than 1e+15"),
        ("0.1,1,-1e308", "line 3: force_x is larger than 1e+15"),
        ("1e18,1,1", "line 3: t is larger than 1e+15"),
        ("0.1,1_0,1", "line 3, column q_yaw: '1_0' is no number"),
        ("0.1,\u0661,1", "line 3, column q_yaw: '\u0661' is no number"),
    ],
)
def test_a_bad_line_is_skipped_and_said(line, said):
    pipe = Pipe()
    rows = pipe.write(f"t,q_yaw,force_x\n0.0,1,1\n{line}\n0.2,3,1\n")
    np.testing.assert_array_equal(rows[:, 1], [1.0, 3.0])
    assert pipe.stream.bad_lines == 1
    assert pipe.said == [f"log: {said}: skipped"]
    strict = Pipe(strict=True)
    with pytest.raises(InputError, match=said.split(":")[0]):
        strict.write(f"t,q_yaw,force_x\n0.0,1,1\n{line}\n0.2,3,1\n")


def test_a_position_may_be_missing():
    rows = Pipe().write("t,q_yaw,force_x\n0.0,,1\n0.1,nan,1\n0.2,NaN,1\n")
    assert np.isnan(rows[:, 1]).all()
    np.testing.assert_array_equal(rows[:, [0, 2]], [[0.0, 1.0], [0.1, 1.0], [0.2, 1.0]])


def test_what_is_no_log_is_refused_and_complaints_are_few():
    pipe = Pipe()
    pipe.write("t,q_yaw,force_x\n" + "x,1,1\n" * 50)
    assert pipe.stream.bad_lines == 50
    assert len(pipe.said) == 3
    assert "only counted" in pipe.said[-1]
    with pytest.raises(InputError, match=r"log: line 2.*no column 'force_x'"):
        Pipe().write("# head\nt,q_yaw,force\n")
    pipe = Pipe()
    pipe.write("t,q_yaw,force_x\n")
    with pytest.raises(InputError, match="line without end"):
        for _ in range(40):
            pipe.write(b"\x00" * 50_000)


def test_raw_columns_of_a_session_become_si():
    layout = conversion_of_stream(read_session(SAMPLES / "first"))
    pipe = Pipe((SI, layout))
    rows = pipe.write(
        "time_us,enc_yaw,enc_pitch,enc_extension,brake_yaw,brake_pitch,brake_extension,"
        "force_x_v,force_y_v,force_z_v\n2000000,33333.3333,-4000,3000,1,2,3,1.021,-0.034,0.012\n"
    )
    found = dict(zip(pipe.stream.names, rows[0], strict=True))
    assert found["t"] == pytest.approx(2.0)
    assert found["q_yaw"] == pytest.approx(1.0)
    assert found["q_pitch"] == found["q_extension"] == 0.0
    assert [found[f"brake_{axis}"] for axis in ("yaw", "pitch", "extension")] == [1.0, 2.0, 3.0]
    forces = [found[f"force_{component}"] for component in "xyz"]
    np.testing.assert_allclose(forces, [12.0, 0.1, -0.05], atol=1e-12)


def test_motors_that_several_joints_turn_give_the_positions_of_these():
    table = {
        "schema": "bampipe.session/1", "session_id": "s", "device": "d", "sample_rate_hz": 100,
        "time": {"column": "t", "unit": "s"}, "trials": [{"file": "a.csv", "kind": "free"}],
        "encoders": {
            "one": {"column": "a", "unit": "rad"},
            "two": {"column": "b", "unit": "rad", "zero_counts": 1.0, "also_reads": {"one": 2.0}},
        },
    }  # fmt: skip
    session = session_from(table, Path())
    rows = Pipe((conversion_of_stream(session),)).write("t,a,b\n0,0.1,1.4\n1,0.2,\n2,,1.5\n")
    np.testing.assert_allclose(rows[:, 1], [0.1, 0.2, np.nan])
    np.testing.assert_allclose(rows[:, 2], [0.2, np.nan, np.nan], atol=1e-12)
    raw = {"t": np.arange(2.0), "a": np.array([0.1, 0.2]), "b": np.array([1.4, 1.7])}
    trial = RawTrial(raw, np.arange(2))
    si = to_si(TrialTable(trial, session, session.trials[0], CleaningLimits()))
    np.testing.assert_allclose([si["q_one"], si["q_two"]], [[0.1, 0.2], [0.2, 0.3]])
