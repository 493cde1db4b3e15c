"""Mutation testing: change one place of the code at a time, and check that a test fails.

    pip install cosmic-ray pytest-cov
    pytest --dist no --cov=jaxnbv --cov-context=test --cov-report= --durations=0 > runs/durations.txt
    python benchmarks/mutants.py --mutants 200 --durations runs/durations.txt --out runs/mutants.json

Mutants are those of cosmic-ray: another operator, comparison or number, a negated condition, a loop without a pass, an
exception that is not caught. Places are drawn at random from the packages named below, without annotations, and one
mutant is made at each place. It runs against the tests that execute its statement, then those that execute anything in
its module, until one fails. Tests in the file named after the module come first, then the quickest, up to two minutes
in all. Run it in a clone, because it rewrites the files there and restores them. Continues after the last mutant in
--out.
"""

import argparse
import ast
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from tqdm import tqdm

PARTS = ("surfaces", "scanning", "sampler.py", "search", "planning", "storage")
SECONDS = 120.0


def places(path: Path) -> dict[tuple[int, int], list[tuple[str, int]]]:
    """Places where a file can be changed, with the operators and their occurrences there."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names

    code = path.read_text()
    parsed, by_place = get_ast(code), {}
    for name in operator_names():
        # An operator with arguments changes nothing without them.
        if (kind := get_operator(name)).arguments():
            continue
        positions = [position for node in ast_nodes(parsed) for position, _ in kind().mutation_positions(node)]
        for occurrence, position in enumerate(positions):
            by_place.setdefault(position, []).append((name, occurrence))
    annotations = [note for node in ast.walk(ast.parse(code)) if (note := annotation(node)) is not None]
    return {
        position: mutations
        for position, mutations in by_place.items()
        if not any(covers(note, position) for note in annotations)
    }


def annotation(node: ast.AST) -> ast.AST | None:
    return getattr(node, "annotation", None) or getattr(node, "returns", None)


def covers(node: ast.AST, position: tuple[int, int]) -> bool:
    return (node.lineno, node.col_offset) <= position < (node.end_lineno, node.end_col_offset)


def statement(code: str, line: int) -> range:
    """Lines of the smallest statement around a line, or of its head if it contains other statements."""
    statements = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.stmt)]
    first = {node: min(one.lineno for one in (node, *getattr(node, "decorator_list", ()))) for node in statements}
    inner = max((node for node in statements if first[node] <= line <= node.end_lineno), key=first.__getitem__)
    body = getattr(inner, "body", None)
    return range(first[inner], max(body[0].lineno, line + 1) if body else inner.end_lineno + 1)


def tests_of(path: Path, code: str, line: int, by_line: dict[int, list[str]], seconds: dict[str, float]) -> list[str]:
    """Names of the tests to run, in order. `by_line`: tests that execute each line. `seconds`: time of each test."""

    def running(lines: Iterable[int]) -> set[str]:
        return {context.rpartition("|")[0] for each in lines for context in by_line.get(each, ()) if context}

    def order(name: str) -> tuple[bool, float, str]:
        return f"test_{path.stem}.py" not in name, seconds.get(name, 0.0), name

    # Only the first test of a process that needs a compiled function traces it, so others may need the line too.
    of_statement, of_module = running(statement(code, line)), running(by_line)
    names = [*sorted(of_statement, key=order), *sorted(of_module - of_statement, key=order)]
    total_seconds = np.cumsum([seconds.get(name, 0.0) for name in names])
    return names[: 1 + int(np.searchsorted(total_seconds, SECONDS))]


def outcome(path: Path, mutated: str, tests: list[str]) -> str:
    """Whether the mutant is "killed" or "survived". Restores the file."""
    if not tests:
        return "no test"
    code, times = path.read_text(), path.stat()
    path.write_text(mutated)
    # Python recognises a compiled file by its size and the second of its change.
    os.utime(path, (time.time() + 10, times.st_mtime + np.random.default_rng().integers(1, 1 << 20)))
    command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", "-o", "addopts=", *tests]
    try:
        return_code = subprocess.run(command, capture_output=True, timeout=3.0 * SECONDS).returncode
    except subprocess.TimeoutExpired:
        return "no end"
    finally:
        path.write_text(code)
        os.utime(path, (times.st_atime, times.st_mtime))
    return "killed" if return_code else "survived"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=200)
    parser.add_argument("--coverage", default=".coverage")
    parser.add_argument("--durations", type=Path, required=True, help="what pytest --durations=0 printed")
    parser.add_argument("--out", type=Path, default=Path("runs/mutants.json"))
    options = parser.parse_args()
    # The tests do not depend on it.
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator
    from coverage import CoverageData

    coverage_data = CoverageData(options.coverage)
    coverage_data.read()
    durations = re.findall(r"^([\d.]+)s \w+ +(tests\S.*)$", options.durations.read_text(), re.MULTILINE)
    seconds: dict[str, float] = {}
    for duration, name in durations:
        seconds[name] = seconds.get(name, 0.0) + float(duration)
    files = [
        file for part in PARTS for file in sorted(Path("jaxnbv").glob(f"{part}/**/*.py" if "." not in part else part))
    ]
    all_places = [(path, position, mutations) for path in files for position, mutations in places(path).items()]
    random = np.random.default_rng(0)
    rows = json.loads(options.out.read_text()) if options.out.exists() else []
    indices = random.choice(len(all_places), options.mutants, replace=False)
    for number, index in enumerate(tqdm(indices, unit="mutant")):
        path, position, mutations = all_places[index]
        name, occurrence = mutations[random.integers(len(mutations))]
        if number < len(rows):
            continue
        code = path.read_text()
        mutated = mutate_code(code, get_operator(name)(), occurrence)
        tests = tests_of(path, code, position[0], coverage_data.contexts_by_lineno(str(path.resolve())), seconds)
        after = mutated.splitlines()[position[0] - 1].strip()
        rows.append({"at": f"{path}:{position[0]}", "to": after, "by": name, "is": outcome(path, mutated, tests)})
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(rows, indent=1))
    for row in rows:
        if row["is"] not in ("killed", "no end"):
            print(f"{row['is']}: {row['at']}  {row['to']}")
    print(
        f"{sum(row['is'] in ('killed', 'no end') for row in rows)} of {len(rows)} killed, of {len(all_places)} places"
    )


if __name__ == "__main__":
    main()
