"""What is shown below the options of each command: how it is typed, and what for."""

from __future__ import annotations

EXAMPLES: dict[str, tuple[tuple[str, str], ...]] = {
    "demo": (
        ("scanweld demo", "see the whole job on a rendered room"),
        ("scanweld demo --frames 30 --out my-demo", "shorter, and kept elsewhere"),
    ),
    "check": (
        ("scanweld check desk", "is it fit to be mapped?"),
        ("scanweld check desk --depth-scale 1000 --json", "for a script"),
    ),
    "slam": (
        ("scanweld slam desk --out run", "map a recording"),
        ("scanweld slam desk.r3d --frames 100:400 --scale 0.5", "a part, half the size"),
        ("scanweld slam desk --set surfaces.max_depth_m=4", "change one setting"),
        ("scanweld slam building --fragments 8", "a long one, in 8 parts at a time"),
    ),
    "batch": (
        ("scanweld batch recordings/* --out runs", "all of them, on all cores"),
        ("scanweld batch a b --out runs --sweep surfaces.levels=2,3", "which is better?"),
        ("scanweld batch s3://lab/a --out runs --scheduler tcp://head:8786", "a cluster"),
    ),
    "register": (
        ("scanweld register a.ply b.ply --plot pair.png", "align two scans, and look"),
        ("scanweld register a.ply b.ply --global", "without a first guess"),
        ("scanweld register a.laz b.laz --voxel 0.1 --method gicp", "large, noisy ones"),
    ),
    "evaluate": (
        ("scanweld evaluate run/trajectory.txt truth.txt", "how far off?"),
        ("scanweld evaluate a.txt b.txt --align sim3 --plot error.png", "with scale"),
    ),
    "render": (
        ("scanweld render --out room --noise kinect", "a room as a Kinect sees it"),
        ("scanweld render --out tiny --size 160x120 --frames 20", "to try things"),
    ),
    "repeat": (
        ("scanweld repeat run", "does the same come of it?"),
        ("scanweld repeat run --threads 1 --out again", "kept, to look at"),
    ),
    "report": (
        ("scanweld report run", "make the page again"),
        ("scanweld report run --truth groundtruth.txt --out desk.html", "with the truth"),
    ),
    "view": (
        ("scanweld view run", "look around in a finished run"),
        ("scanweld slam desk --view", "watch one while it goes by"),
    ),
    "mesh": (
        ("scanweld mesh run", "a mesh beside the run's files"),
        ("scanweld mesh run --out room.glb --voxel 0.005", "finer, for browsers"),
        ("scanweld mesh run --splat", "Gaussian splats"),
    ),
    "config": (
        ("scanweld config show > my.toml", "a file to change"),
        ("scanweld config check my.toml", "is it sound?"),
    ),
    "datasets": (
        ("scanweld datasets list", "what is read"),
        ("scanweld datasets check desk", "how a recording is understood"),
    ),
    "bench": (
        ("scanweld bench", "the speed of this machine"),
        ("scanweld bench stages desk --frames 100", "where a frame's time goes"),
    ),
    "warmup": (("scanweld warmup", "compile before the first run"),),
    "completion": (
        ('eval "$(scanweld completion bash)"', "in ~/.bashrc; zsh likewise"),
        ("scanweld completion fish | source", "in ~/.config/fish/config.fish"),
    ),
}


def examples_of(command: str) -> str | None:
    """Return the text below a command's help: a paragraph for each example, since the parser keeps no lines."""
    rows = [f"{typed}  # {what}" for typed, what in EXAMPLES.get(command, ())]
    return "\n\n".join(["Examples:", *rows]) if rows else None
