"""Check of the installation: one OpenCV, the headless contrib build, that imports and works without libGL.

python -m workflow.environment
"""

from __future__ import annotations

import re
from importlib import metadata

HEADLESS = "opencv-contrib-python-headless"
REPAIR = "pip uninstall -y {wrong} && pip install --force-reinstall --no-deps -r requirements.txt"


def opencv_owners() -> list[str]:
    """Names of the installed distributions that hold a file of the package cv2."""
    owners = set()
    for distribution in metadata.distributions():
        name = distribution.metadata["Name"] or ""
        if name.lower().startswith("opencv") and any(str(file).startswith("cv2/") for file in distribution.files or ()):
            owners.add(name.lower().replace("_", "-"))
    return sorted(owners)


def problem() -> str | None:
    """What is wrong with the installed OpenCV, with the command that mends it, or None."""
    owners = opencv_owners()
    if owners != [HEADLESS]:
        wrong = " ".join(owner for owner in owners if owner != HEADLESS)
        return f"OpenCV: found {', '.join(owners) or 'none'}, expected {HEADLESS} alone; {REPAIR.format(wrong=wrong)}"
    import cv2

    if not re.search(r"GUI:\s+NONE", cv2.getBuildInformation()) or not hasattr(cv2, "ximgproc"):
        return f"OpenCV: this cv2 is not the headless contrib build; {REPAIR.format(wrong='opencv-contrib-python')}"
    return None


if __name__ == "__main__":
    found = problem()
    if found:
        raise SystemExit(found)
    import cv2

    print(f"OpenCV {cv2.__version__}: headless, alone")
