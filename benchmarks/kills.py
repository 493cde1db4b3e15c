"""Kill runs at well spread moments and start them again: each ends with the files of a run that was left alone.

    python benchmarks/kills.py --kills 200 --out runs/kills

Commands are a run, its figures, a study, and a session that is planned again, at small settings; each is killed
(SIGKILL) at moments that are spread over the time that it takes, and started again until it has been killed so often.
Then it is let through. Not part of the tests: about ten seconds a kill.
"""

import argparse
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

import jaxnbv as nbv

COMMANDS = {
    "run": ("demo", "--quick", "--views", "4", "--until", "never", "--no-report"),
    "figures": ("demo", "--quick", "--views", "2", "--until", "never"),
    "study": ("study", "pyramid", "--quick", "--scenes", "3", "--views", "2", "--framing", "close-up"),
    "session": ("session", "replay", "SESSION", "--quick", "--no-report"),
}
# What says when it was made, and by what means.
UNLIKE = {"report.html", ".lock"}


def record_session(folder: Path) -> None:
    """Four images of a ball by a simulated sensor, from where its planner asked for them."""
    camera, ball = nbv.Camera(height=48, width=64), nbv.SDFSurface(nbv.sdf.Sphere(0.1))
    planner = nbv.Planner(
        nbv.Coverage(),
        nbv.DiscreteSearch(20),
        nbv.Camera(height=12, width=16),
        nbv.Imagination(nbv.GeometricSPSR(0.05, truncation=12), num_samples=2),
    )
    session = nbv.Session(camera, ((-0.12, -0.12, -0.12), (0.12, 0.12, 0.12)), planner, folder=folder)
    matrix = np.asarray(nbv.look_at((0.0, 0.1, 0.3)).matrix)
    while session.views < 4:
        seen, pose = nbv.scan(ball, camera, nbv.Pose.from_matrix(matrix)), nbv.Pose.from_matrix(matrix)
        depth = np.asarray((seen.points - pose.position) @ pose.forward).reshape(48, 64)
        session.add(np.where(np.asarray(seen.mask).reshape(48, 64), depth, np.inf), matrix)
        matrix = session.next().matrix


def start(arguments: tuple[str, ...], out: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", "jaxnbv.cli", *arguments, "--out", str(out)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in UNLIKE)
    return {str(path.relative_to(folder)): content(path) for path in files}


def content(path: Path) -> bytes:
    """Of a study's record all but the seconds that it took."""
    if not path.name.startswith("scene_"):
        return path.read_bytes()
    record = json.loads(path.read_text())["record"]
    return json.dumps({key: value for key, value in record.items() if key != "seconds"}).encode()


def let_through(arguments: tuple[str, ...], out: Path) -> float:
    """Seconds that it took."""
    began = time.monotonic()
    process = start(arguments, out)
    _, errors = process.communicate()
    if process.returncode:
        raise SystemExit(f"{' '.join(arguments)} ended with {process.returncode}: {errors.decode()[-2000:]}")
    return time.monotonic() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--out", type=Path, default=Path("runs/kills"))
    asked = parser.parse_args()
    shutil.rmtree(asked.out, ignore_errors=True)
    random, failures = np.random.default_rng(0), []
    share = -(-asked.kills // len(asked.commands))
    if "session" in asked.commands:
        record_session(asked.out / "recorded")
    for name in asked.commands:
        arguments = tuple(str(asked.out / "recorded") if word == "SESSION" else word for word in COMMANDS[name])
        # The second time all programs are compiled, as they will be when it is killed.
        let_through(arguments, asked.out / f"{name}-first")
        seconds = let_through(arguments, asked.out / f"{name}-whole")
        expected, killed = contents(asked.out / f"{name}-whole"), 0
        with tqdm(total=share, desc=name, unit="kill") as bar:
            while killed < share:
                out = asked.out / f"{name}-killed"
                shutil.rmtree(out, ignore_errors=True)
                # A few times the same folder, at moments of strata over the whole time.
                for moment in random.permutation(min(5, share - killed)):
                    process = start(arguments, out)
                    time.sleep(seconds * (moment + random.random()) / 5)
                    killed += process.poll() is None
                    process.kill()
                    process.communicate()
                bar.update(killed - bar.n)
                let_through(arguments, out)
                if contents(out) != expected:
                    differ = [file for file, found in contents(out).items() if expected.get(file) != found]
                    failures.append(f"{name} after {killed} kills: {differ or sorted(expected)}")
        print(f"{name}: {killed} kills of {seconds:.0f} s")
    print("\n".join(failures) or "every run ended with the files of one that was left alone")
    sys.exit(bool(failures))


if __name__ == "__main__":
    main()
