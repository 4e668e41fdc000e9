"""How many samples a second `bampipe monitor` keeps up with on one core, and in what memory.

Simulated trials of the BAM, written as text in SI columns one after the other, are read through a
pipe as the command reads them: parsing, filter, alarm and a report every second of data.

``python benchmarks/monitor_rate.py [--samples N]``
"""

from __future__ import annotations

import argparse
import os
import resource
import time

import numpy as np

from bampipe.data.stream import SampleStream
from bampipe.monitor.monitor import Monitor
from bampipe.monitor.start import MonitorOptions, list_layouts
from bampipe.physics import Model, compile_model, registry

RATE = 5000.0


def record(count: int) -> tuple[tuple[str, ...], np.ndarray]:
    """A motion within range at 5 kHz; its physics do not matter for the time it takes."""
    t = np.arange(count) / RATE
    steps = np.array([4.6875e-5, 9.8125e-5, 3.0e-5])
    motion = [0.3 * np.sin(2.0 * t), 0.1 * np.sin(1.7 * t), 1.1 + 0.05 * np.sin(2.3 * t)]
    q = np.round(np.stack(motion, axis=1) / steps) * steps
    force = np.random.default_rng(0).normal(size=(count, 3)) * 0.05
    names = ("t", "q_yaw", "q_pitch", "q_extension", "force_x", "force_y", "force_z")
    return names, np.hstack([t[:, None], q, force])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--samples", type=int, default=200_000)
    count = parser.parse_args().samples
    system = compile_model(Model(registry.device("bam")))
    names, values = record(10_000)
    source, sink = os.pipe()
    stream = SampleStream(source, "pipe", list_layouts(system, None), True, print)
    watch = Monitor(system, None, MonitorOptions(), lambda _: None)
    os.write(sink, (",".join(names) + "\n").encode())
    stream.read()
    taken, seconds, before, reported = 0, 0.0, 0, 0.0
    while taken < count:
        shifted = values[:200].copy() if taken == 0 else values[(taken % 10_000) :][:200].copy()
        shifted[:, 0] = (taken + np.arange(len(shifted))) / RATE
        text = "\n".join(",".join(map(repr, row)) for row in shifted.tolist()) + "\n"
        os.write(sink, text.encode())
        begun = time.process_time()
        found = stream.read()
        watch.push(stream.names, found)
        if shifted[-1, 0] >= reported + 1.0:
            watch.report()
            reported = float(shifted[-1, 0])
        seconds += time.process_time() - begun
        taken += len(found)
        if taken == 20_000:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"{taken} samples, load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print(f"{taken / seconds:,.0f} samples per second of processor time")
    print(f"peak memory grew by {(after - before) / 1024:.1f} MB after the first 20000 samples")


if __name__ == "__main__":
    main()
