"""All benchmarks by one command: ``python -m tests.benchmarks [word ...]``.

Every ``bench_*.py`` beside this file runs in an interpreter of its own, so that one that fails or
fills the memory leaves the others alone.  Words choose those whose name has one of them in it.
They measure, and are never part of the tests' pass or fail.
"""

import subprocess
import sys
import time
from pathlib import Path


def main() -> int:
    """Run them in order; return how many did not end well."""
    folder = Path(__file__).resolve().parent
    words = sys.argv[1:]
    scripts = [
        script
        for script in sorted(folder.glob("bench_*.py"))
        if not words or any(word in script.stem for word in words)
    ]
    if not scripts:
        print(f"no benchmark has one of {', '.join(words)} in its name")
        return 2
    failed = []
    for script in scripts:
        print(f"\n=== {script.stem} {'=' * (90 - len(script.stem))}", flush=True)
        began = time.perf_counter()
        code = subprocess.run([sys.executable, str(script)], check=False).returncode
        print(f"--- {time.perf_counter() - began:.1f} s", flush=True)
        if code:
            failed.append(f"{script.stem} (exit code {code})")
    print(f"\n{len(scripts)} benchmarks, {len(failed)} failed {', '.join(failed)}")
    return len(failed)


if __name__ == "__main__":
    sys.exit(main())
