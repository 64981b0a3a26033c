"""Every fault at every moment, and what came of it: ``python -m tests.benchmarks faults``.

At the end those of an EPOS4, whose ways differ, at the moments at which they show.

Run by itself it takes words of faults' names, and ``@`` with words of moments' names.

Exit code, cycles until all drives that were under power had left operation enabled; where only motion
shows the fault, cycles from when it could be seen, and those that the tool took longer than somebody
who knows plant, noise and fault (``tests.faults.clairvoyant``); how far the motor of the faulty drive
had gone by then (degrees), time until the last power stage was off, how far a motor went in the end,
rows kept on the disk, and what was said.
"""

import math
import sys
import textwrap
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.faults.bench import ARM, Moment
from tests.faults.table import EPOS4_CASES, ROWS, problems, try_row

MOMENTS = [word[1:] for word in sys.argv[1:] if word.startswith("@")]


def main() -> int:
    words = [word for word in sys.argv[1:] if not word.startswith("@")]
    moments = [m for m in Moment if not MOMENTS or any(word in m.value for word in MOMENTS)]
    wrong = cases = 0
    began = time.process_time()
    print(
        f"{'fault':36}{'moment':18}{'code':>5}{'cycles':>8}{'visible':>8}{'beyond':>8}{'deg':>8}"
        f"{'off s':>8}{'rad':>7}{'rows':>6}  outcome"
    )
    for row, times in (*((row, tuple(Moment)) for row in ROWS), *EPOS4_CASES):
        if words and not any(word in row.name for word in words):
            continue
        for moment in (m for m in times if m in moments):
            result, expected = try_row(row, moment), row.expected(moment)
            found = problems(result, expected, moment)
            cases += 1
            wrong += bool(found)
            watch = result.watch
            acted = bool(watch.powered_then) and result.code
            acted = acted and (not expected.whole or result.best is not None)
            cycles = f"{result.cycles():8.1f}" if acted else f"{'':>8}"
            visible = beyond = f"{'':>8}"
            if acted and result.best is not None:
                seen, best = result.best.visible, result.best.decided
                visible = f"{'never' if seen is None else f'{result.cycles() - seen:.1f}':>8}"
                beyond = f"{'never' if best is None else f'{result.cycles() - best:.1f}':>8}"
            way = watch.unseen.get(ARM)
            unseen = f"{math.degrees(way):8.2f}" if acted and way is not None else f"{'':>8}"
            off = f"{max(watch.off.values()):8.3f}" if acted and watch.off else f"{'':>8}"
            far = max(watch.farthest.values(), default=0.0)
            said = result.said.split("fieldtool: ", 1)[-1] if result.code else expected.why
            print(
                f"{row.name:36}{moment.value:18}{result.code:5}{cycles}{visible}{beyond}{unseen}{off}{far:7.2f}"
                f"{sum(result.rows):6}  {'WRONG: ' + '; '.join(found) if found else 'ok'}"
            )
            print(textwrap.indent(textwrap.shorten(said, 220), "    "))
    seconds = time.process_time() - began
    print(f"{cases} cases, {wrong} not as they have to be, {seconds:.0f} s of CPU")
    return wrong


if __name__ == "__main__":
    sys.exit(min(main(), 1))
