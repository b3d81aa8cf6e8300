"""Coverage-guided fuzzing of what `targets` has: ``python -m tests.fuzz --seconds 60 [TARGET...]``.

It needs atheris (`make fuzz` gets it). Every target runs in a process of its own; what makes one
fail is written to the corpus folder and named, and ``--again FILE TARGET`` tries it once more.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

#: Of the inputs; longer than what is refused unread.
LONGEST = 300_000
#: Memory, MB, that no input may take: the process has 300 before the first.
MOST_MB = 1_024


def _fuzz(name: str, corpus: Path, seconds: float) -> None:
    import atheris

    with atheris.instrument_imports(include=["dwell.live", "dwell.live.trust", "dwell.errors"]):
        from tests.fuzz.targets import TARGETS, seeds
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(seeds(name)):
        (corpus / f"seed-{number}").write_bytes(seed)
    TARGETS[name](b"")
    limits = f"-max_total_time={seconds:.0f}", f"-max_len={LONGEST}", f"-rss_limit_mb={MOST_MB}"
    more = "-timeout=10", "-print_final_stats=1", f"-artifact_prefix={corpus.parent}/{name}-"
    atheris.Setup([sys.argv[0], *limits, *more, "-verbosity=0", str(corpus)], TARGETS[name])
    atheris.Fuzz()


def main(arguments: Sequence[str] | None = None) -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", help="all if left out")
    parser.add_argument("--seconds", type=float, default=60, help="of each target")
    parser.add_argument("--corpus", type=Path, default=Path("fuzz-corpus"))
    parser.add_argument("--again", type=Path, help="a file that made a target fail")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    if asked.here:
        # What has been imported before is not instrumented.
        _fuzz(asked.targets[0], asked.corpus / asked.targets[0], asked.seconds)
        return 0
    from tests.fuzz.targets import TARGETS

    names = asked.targets or list(TARGETS)
    if unknown := [name for name in names if name not in TARGETS]:
        parser.error(f"no target {unknown[0]!r}; there are {', '.join(TARGETS)}")
    if asked.again is not None:
        for name in names:
            TARGETS[name](asked.again.read_bytes())
        return 0
    failed = []
    for name in names:
        print(f"== {name}", flush=True)
        words = [name, "--here", "--seconds", str(asked.seconds), "--corpus", str(asked.corpus)]
        if subprocess.run([sys.executable, "-m", "tests.fuzz", *words], check=False).returncode:
            failed.append(name)
    print(f"failed: {', '.join(failed)}" if failed else "nothing failed")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
