"""`python -m tests.fuzz NAME [libFuzzer options]`: a coverage-guided fuzzer on one target; its corpus is kept here.

Without a name it lists the targets. `make fuzz` runs all parsers one after the other.
"""

import sys
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["drivers", "simulators", "cobs"]):
    from tests.fuzz.targets import TARGETS, seeds

CORPUS = Path(__file__).parent / "corpus"


def main() -> None:
    """Fuzz the target named first; everything behind it goes to libFuzzer."""
    if len(sys.argv) < 2 or sys.argv[1] not in TARGETS:
        sys.exit(f"say which target: {', '.join(TARGETS)}")
    name = sys.argv[1]
    corpus = CORPUS / name
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(seeds(name)):
        (corpus / f"seed-{number}").write_bytes(seed)
    atheris.Setup([sys.argv[0], *sys.argv[2:], str(corpus)], TARGETS[name])
    atheris.Fuzz()


main()
