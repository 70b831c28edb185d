"""``python -m tests.support.hub --root DIR [--port P] [--token=T]``: serve until interrupted."""

from __future__ import annotations

import argparse
import contextlib

from tests.support.hub.server import FakeHub


def main() -> None:
    """Serve; say how to point other programs here."""
    parser = argparse.ArgumentParser(prog="tests.support.hub", description=__doc__)
    parser.add_argument("--root", required=True, help="folder of the repositories")
    parser.add_argument("--port", type=int, default=0, help="port on the loopback; 0: any")
    parser.add_argument("--token", default="", help="token needed to write; empty: none")
    args = parser.parse_args()
    hub = FakeHub(args.root, args.port, args.token)
    print(f"export HF_ENDPOINT={hub.endpoint} HF_HUB_DISABLE_XET=1", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        hub.serve()


if __name__ == "__main__":
    main()
