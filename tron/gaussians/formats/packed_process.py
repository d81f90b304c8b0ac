"""The process in which gaussforge reads and writes packed splats: it crashes on some damaged files.

    python -I packed_process.py SITE FROM TO BYTES < input > output

SITE is the folder that gaussforge is installed in, FROM and TO are its names of formats, BYTES is the most
memory that the process may ask for. What went wrong is the last line on stderr.
"""

import os
import sys


def main(site: str, source: str, target: str, memory: str) -> None:
    """Convert stdin to stdout."""
    sys.path.insert(0, site)
    output = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # gaussforge prints there
    try:
        import resource
    except ImportError:  # Windows has no such limit
        pass
    else:
        resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    import gaussforge

    converted = gaussforge.GaussForge().convert(sys.stdin.buffer.read(), source, target)
    if "error" in converted:
        sys.exit(converted["error"])
    with open(output, "wb") as stream:
        stream.write(converted["data"])


if __name__ == "__main__":
    main(*sys.argv[1:])
