"""Kill runs at moments spread over their time, and start them again. Each must end with the files of a run that was
not killed.

    python benchmarks/kills.py --kills 1000 --out runs/kills

Commands are a run, two runs at once in one folder, the report of a run, a study by one process and by two, and a
session with its report, all at small settings. Each is killed (SIGKILL) and started again until it has had its share of
the kills. The last start runs to its end. A kill takes about five seconds, so this is not one of the tests.
"""

import argparse
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import trimesh
from tqdm import tqdm

import jaxnbv as nbv
from jaxnbv.compiled import keep_compiled

RUN = ("run", "BOX.PLY", "--quick", "--views", "4")
STUDY = ("study", "pyramid", "--quick", "--scenes", "2", "--views", "2", "--methods", "coverage,farthest")
COMMANDS = {
    "run": (*RUN, "--no-report"),
    "two runs in one folder": (*RUN, "--no-report"),
    "report": RUN,
    "study": STUDY,
    "study by two processes": (*STUDY, "--workers", "2"),
    "session": (),
}
STRATA = 8
# Files that differ between equal runs, since they hold the time.
UNLIKE = {"report.html", ".lock"}


def take_session(folder: Path) -> None:
    """Run a session with four images of a ball by a simulated sensor, from proposed poses, and write its report."""
    keep_compiled()
    camera, ball = nbv.Camera(height=48, width=64), nbv.SDFSurface(nbv.sdf.Sphere(0.1))
    planner = nbv.Planner(
        nbv.Coverage(),
        nbv.DiscreteSearch(20),
        nbv.Camera(height=12, width=16),
        nbv.SurfaceSampler(nbv.GeometricSPSR(0.05, truncation=12), nbv.Grid(32), num_samples=2),
        capacity=256,
    )
    session = nbv.Session(camera, ((-0.12, -0.12, -0.12), (0.12, 0.12, 0.12)), planner, up="y", folder=folder)
    first = nbv.look_at((0.0, 0.1, 0.3))
    while len(session.views) < 4:
        matrix = np.asarray(session.next().matrix if session.views else first.matrix)
        pose = nbv.Pose.from_matrix(matrix)
        cloud = nbv.scan(ball, camera, pose)
        depth = np.asarray((cloud.points - pose.position) @ pose.forward).reshape(48, 64)
        session.add(np.where(np.asarray(cloud.mask).reshape(48, 64), depth, np.inf), matrix)
    nbv.write_report(session.episode, folder / "report")


def start(name: str, out: Path, inputs: Path) -> list[subprocess.Popen]:
    """Start the processes of a command, which write to a folder."""
    words = [str(inputs / "box.ply") if word == "BOX.PLY" else word for word in COMMANDS[name]]
    if name == "session":
        command = [sys.executable, __file__, "--session", str(out)]
    else:
        out.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "jaxnbv", *words, "--out", str(out)]
    return [
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        for _ in range(2 if name == "two runs in one folder" else 1)
    ]


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in UNLIKE)
    return {str(path.relative_to(folder)): content(path) for path in files}


def content(path: Path) -> bytes:
    """The bytes of a file. In records of a study all times are set to zero."""
    if not path.name.startswith("scene_"):
        return path.read_bytes()
    record = json.loads(path.read_text(), object_hook=lambda fields: fields | {"seconds": 0})["record"]
    return json.dumps(record).encode()


def run_to_end(name: str, out: Path, inputs: Path) -> float:
    """Run a command to its end. Returns its seconds."""
    start_time = time.monotonic()
    process, *others = start(name, out, inputs)
    _, errors = process.communicate()
    for other in others:
        other.communicate()
    # The folder's lock may have refused this process while the other ran. Run it again, alone.
    if process.returncode and others:
        return run_to_end(name, out, inputs)
    if process.returncode:
        raise SystemExit(f"{name} ended with {process.returncode}: {errors.decode()[-2000:]}")
    return time.monotonic() - start_time


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--out", type=Path, default=Path("runs/kills"))
    parser.add_argument("--session", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.session:
        return take_session(options.session)
    shutil.rmtree(options.out, ignore_errors=True)
    (inputs := options.out / "inputs").mkdir(parents=True)
    trimesh.creation.box((1.0, 0.7, 0.5)).export(inputs / "box.ply")
    random, failures = np.random.default_rng(0), []
    kills_per_command = -(-options.kills // len(options.commands))
    for name in options.commands:
        # The second run compiles nothing, like the runs that are killed.
        run_to_end(name, options.out / name / "first", inputs)
        seconds = run_to_end(name, options.out / name / "whole", inputs)
        expected, num_killed = contents(options.out / name / "whole"), 0
        with tqdm(total=kills_per_command, desc=name, unit="kill") as bar:
            while num_killed < kills_per_command:
                shutil.rmtree(out := options.out / name / "killed", ignore_errors=True)
                # Kill several times in the same folder, at one random moment of each stratum of the run's time.
                for moment in random.permutation(min(STRATA, kills_per_command - num_killed)):
                    processes = start(name, out, inputs)
                    time.sleep(seconds * (moment + random.random()) / STRATA)
                    num_killed += any(process.poll() is None for process in processes)
                    for process in processes:
                        process.kill()
                        process.communicate()
                bar.update(num_killed - bar.n)
                run_to_end(name, out, inputs)
                if contents(out) != expected:
                    changed_files = [
                        file for file, content_now in contents(out).items() if expected.get(file) != content_now
                    ]
                    failures.append(f"{name} after {num_killed} kills: {changed_files or sorted(expected)}")
        print(f"{name}: {num_killed} kills of {seconds:.0f} s")
    print("\n".join(failures) or "every run ended with the files of one that was left alone")
    sys.exit(bool(failures))


if __name__ == "__main__":
    main()
