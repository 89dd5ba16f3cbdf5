"""Soak test: kills, flipped bits, damaged files and load, with figures in two tables.

    python tools/soak.py --work work/soak                  # minutes
    python tools/soak.py --work work/soak --effort 20      # hours
    python tools/soak.py --work work/soak --parts load

`--effort` multiplies the numbers of kills, flips, damaged files and photographs. The exit status is 1 if a run differs after its
kills, a flip goes unnoticed, or a reader fails. docs/reliability.md has the output. The cache is in WORK. It needs Linux.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from result_page import format_command

from bench.cache import store
from bench.codebook.examples import write_dictionary
from bench.codebook.public import ASSETS
from bench.core.device import pick_device, pick_dtype
from bench.core.errors import UserError
from bench.core.table import Table, build_table, to_markdown
from bench.formats import tensor_file
from bench.runner import records

PARTS = ("kills", "flips", "damage", "load")
KILLS, FLIPS, PHOTOGRAPHS = 6, 300, 20  # with effort 1
KEYPOINTS = (5_000, 50_000)  # of one photograph
WORDS = 1_024_000
QUERIES = 700  # keypoints that the words are searched for
# Tests on files that hypothesis damages, as often as SOAK_EFFORT says.
DAMAGE_TESTS = (
    "tests/formats/test_damaged_files.py",
    "tests/formats/test_tensor_file.py",
    "tests/leaderboard/test_hostile_records.py",
)
UNSTABLE = {"seconds", "digest"}  # entries of a record that differ between equal runs


@dataclass(frozen=True, kw_only=True)
class Usage:
    """The resources that a process used."""

    seconds: float  # of the processor
    peak: float  # MB
    output: str


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="an empty or missing folder")
    parser.add_argument("--effort", type=int, default=1, help="factor of the numbers of trials (default: 1)")
    parser.add_argument("--parts", default=",".join(PARTS), help=f"some of {','.join(PARTS)} (default: all)")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    rng, parts = np.random.default_rng(args.seed), args.parts.split(",")
    with store.use_folder(args.work.resolve() / "cache"):
        faults: list[tuple[str, int, int, int]] = []
        if "kills" in parts:
            faults.append(kill_and_resume(args.work, KILLS * args.effort, rng))
        if "flips" in parts:
            faults += flip_files(args.work, FLIPS * args.effort, rng)
        if "damage" in parts:
            faults += [run_damage_tests(test, args.effort) for test in DAMAGE_TESTS]
        loads = list(measure_loads(args.work, PHOTOGRAPHS * args.effort)) if "load" in parts else []
    print(f"`{format_command(sys.argv)}` on {describe_machine()}:\n")
    if faults:
        print(to_markdown(build_faults(faults)))
    if loads:
        print(to_markdown(build_loads(loads)))
    return int(any(wrong for *_, wrong in faults))


def build_faults(faults: Sequence[tuple[str, int, int, int]]) -> Table:
    """Return the table of faults: what was done, the number of trials, those without effect, and the wrong ones."""
    rows = [(fault, f"{trials:,}", f"{harmless:,}", f"{wrong:,}") for fault, trials, harmless, wrong in faults]
    return build_table(("fault", "trials", "without effect", "wrong"), rows, text=("fault",))


def build_loads(loads: Sequence[tuple[str, str, Usage, str]]) -> Table:
    rows = [(work, amount, f"{usage.seconds:.1f}", f"{usage.peak:,.0f}", note) for work, amount, usage, note in loads]
    return build_table(("work", "amount", "core seconds", "peak MB", "note"), rows, text=("work", "amount", "note"))


def describe_machine() -> str:
    """Describe processor, cores, memory and the number format of products."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    dtype = str(pick_dtype(pick_device())).removeprefix("torch.")
    return f"{platform.machine()}, {os.cpu_count()} cores, {memory:.0f} GB, products in {dtype}"


# ---- kills


def kill_and_resume(work: Path, count: int, rng: np.random.Generator) -> tuple[str, int, int, int]:
    """Kill runs at random times, resume them, and compare them with a run that was not killed."""
    album = write_photographs(work / "album", 6)
    start = time.monotonic()
    measure(build_run(album, work / "whole"))
    duration, whole, harmless, wrong = time.monotonic() - start, read_run(work / "whole"), 0, 0
    for number in range(count):
        out = work / f"killed-{number}"
        with subprocess.Popen(build_run(album, out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            try:
                process.wait(rng.uniform(0.2, 1) * duration)  # the first part of the time is imports
            except subprocess.TimeoutExpired:
                process.kill()
            else:
                harmless += 1  # it had ended
        measure(build_run(album, out))
        wrong += read_run(out) != whole
    return "bench run killed by SIGKILL and resumed", count, harmless, wrong


def build_run(photographs: Path, out: Path, *options: str) -> list[str]:
    chosen = options or ("--defense", "none", "--attack", "blank")
    return [sys.executable, "-m", "bench.cli", "run", *chosen, "--images", str(photographs), "--out", str(out)]


def read_run(out: Path) -> tuple[list[dict[str, Any]], dict[str, bytes]]:
    """Return the records of a run without their durations, sorted, and its pictures."""
    latest = records.keep_latest(records.read(out / records.FILE).records)
    stable = [{name: value for name, value in record.items() if name not in UNSTABLE} for record in latest]
    pictures = {str(path.relative_to(out)): path.read_bytes() for path in out.glob("**/*.png") if "figures" not in path.parts}
    return sorted(stable, key=lambda record: str(record["sample"])), pictures


# ---- flipped bits


def flip_files(work: Path, count: int, rng: np.random.Generator) -> Iterator[tuple[str, int, int, int]]:
    """Flip bits of a dictionary, a network, an entry of the cache and records."""
    (work / "flips").mkdir(exist_ok=True)
    dictionary = Path(write_dictionary(work / "flips"))
    network = next(iter(sorted(ASSETS.glob("inversion-*.safetensors"))))
    store.fetch("soak", "entry", lambda: ({"values": np.arange(1000)}, {"size": [1, 1]}))
    lines = work / "flips" / records.FILE
    lines.write_bytes(write_records(work))
    for name, path, read in (
        ("a dictionary", dictionary, read_tensors("dictionary")),
        ("a network", network, read_tensors("inversion-network")),
        ("an entry of the cache", store.entry_path("soak", "entry"), read_tensors("soak")),
        ("a file of records", lines, read_records),
    ):
        yield f"one bit of {name} flipped", count, *flip_bits(path.read_bytes(), work / "flips" / "flipped", read, count, rng)


def flip_bits(whole: bytes, path: Path, read: Callable[[Path], object], count: int, rng: np.random.Generator) -> tuple[int, int]:
    """Flip one bit of a file, `count` times. Returns how many flips left its content as it was, and how many went unnoticed."""
    path.write_bytes(whole)
    content, harmless, wrong = read(path), 0, 0
    for _ in range(count):
        flipped = bytearray(whole)
        flipped[rng.integers(len(whole))] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        try:
            same = read(path) == content
        except UserError:
            continue
        harmless, wrong = harmless + same, wrong + (not same)
    return harmless, wrong


def read_tensors(kind: str) -> Callable[[Path], object]:
    """Return a reader of the digest of a file, which `tensor_file.load` compares with its content."""
    return lambda path: tensor_file.load(path, kind)[2]


def read_records(path: Path) -> object:
    contents = records.read(path)
    if contents.notice:
        raise UserError(contents.notice)
    return contents.records


def write_records(work: Path) -> bytes:
    """Return the records of a small run, which is that of `kill_and_resume` if there was one."""
    measure(build_run(write_photographs(work / "album", 6), work / "whole"))
    return (work / "whole" / records.FILE).read_bytes()


# ---- damaged files


def run_damage_tests(test: str, effort: int) -> tuple[str, int, int, int]:
    """Run a file of tests, for which hypothesis draws `effort` times as many examples. Trials are tests."""
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-m", "not exhaustive", test]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"SOAK_EFFORT": str(effort)}, check=False)
    passed, failed = (sum(map(int, re.findall(rf"(\d+) {verdict}", done.stdout))) for verdict in ("passed", "failed"))
    return f"damaged files: tests of {test}", passed + failed, 0, max(failed, int(done.returncode != 0))


# ---- load


def measure_loads(work: Path, photographs: int) -> Iterator[tuple[str, str, Usage, str]]:
    """Measure runs of two sizes each, and the search in a large dictionary."""
    for count in (photographs, 5 * photographs):
        usage = measure(build_run(write_photographs(work / f"photographs-{count}", count), work / f"run-{count}"))
        yield "none, blank", f"{count:,} photographs", usage, f"{usage.seconds / count:.2f} s each"
    for count in KEYPOINTS:
        features = write_features(work / f"features-{count}", count)
        for defense, attack in (("affine", "nearest"), ("ldp", "oracle")):
            options = ("--defense", defense, "--attack", attack, "--extractor", f"hloc:path={features}")
            usage = measure(build_run(features.parent / "photographs", features.parent / defense, *options))
            yield f"{defense}, {attack}", f"{count:,} keypoints", usage, f"{1000 * usage.seconds / count:.1f} ms each"
    usage = measure([sys.executable, "-c", SEARCH])
    ratio, build = json.loads(usage.output.splitlines()[-1])
    note = f"search: {ratio:.2f} times the bare product in float32; index: {build:.1f} s"
    yield f"nearest words of {QUERIES} keypoints", f"{WORDS:,} words", usage, note


SEARCH = f"""
import json, time
import numpy as np, torch
from bench.geometry.nearest_words import BLOCK, WordIndex, unit_rows
rng = np.random.default_rng(0)
words, queries = (rng.integers(0, 120, (count, 128), dtype=np.uint8) for count in ({WORDS}, {QUERIES}))
def clock(call, times=3):
    taken = []
    for _ in range(times):
        start = time.process_time()
        call()
        taken.append(time.process_time() - start)
    return min(taken)
indices = []
build = clock(lambda: indices.append(WordIndex(words)), 1)
rows, block = torch.from_numpy(unit_rows(queries)), torch.from_numpy(unit_rows(words[:BLOCK]))
out = rows.new_empty(len(rows), BLOCK)
def multiply():
    for _ in range(0, {WORDS}, BLOCK):
        torch.mm(rows, block.T, out=out)
print(json.dumps([clock(lambda: indices[0].find_nearest(queries)) / clock(multiply), build]))
"""


def measure(command: Sequence[str]) -> Usage:
    """Execute a command and return what it used.

    Raises
    ------
    RuntimeError
        if it fails.
    """
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        output = process.stdout.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)}: exit status {process.returncode}:\n{output[-2000:]}")
    return Usage(seconds=used.ru_utime + used.ru_stime, peak=used.ru_maxrss / 1000, output=output)


def write_photographs(folder: Path, count: int) -> Path:
    """Write a folder of blurred noise."""
    folder.mkdir(exist_ok=True)
    for number in range(count):
        noise = np.random.default_rng(number).integers(0, 256, (24, 24, 3), dtype=np.uint8)
        Image.fromarray(noise).resize((256, 256), Image.Resampling.BICUBIC).save(folder / f"{number:05}.png")
    return folder


def write_features(folder: Path, count: int) -> Path:
    """Write a photograph and its random features in an HDF5 file of hloc."""
    import h5py

    folder.mkdir(exist_ok=True)
    write_photographs(folder / "photographs", 1)
    rng = np.random.default_rng(0)
    descriptors = rng.uniform(size=(128, count)).astype(np.float32)
    with h5py.File(folder / "features.h5", "w") as file:
        group = file.create_group("00000.png")
        group["keypoints"] = rng.uniform(1, 254, (count, 2)).astype(np.float32)
        group["descriptors"] = descriptors / np.linalg.norm(descriptors, axis=0)
        group["image_size"] = np.array([256, 256])
    return folder / "features.h5"


if __name__ == "__main__":
    sys.exit(main())
