"""What a figure was measured on."""

import platform


def hardware() -> str:
    """Number and name of this machine's processors."""
    try:
        with open("/proc/cpuinfo") as file:
            names = [
                line.split(":", 1)[1].strip() for line in file if line.startswith("model name")
            ]
    except FileNotFoundError:
        names = []
    fallback = platform.processor() or platform.machine()
    return f"{len(names)} cores, {names[0]}" if names else fallback
