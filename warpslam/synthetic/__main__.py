"""``python -m warpslam.synthetic``: draw a contact sheet of random rooms."""

from __future__ import annotations

import argparse

from warpslam.synthetic.contact_sheet import contact_sheet


def main(arguments: list[str] | None = None) -> None:
    """Parse the command line and write the picture."""
    parser = argparse.ArgumentParser(prog="python -m warpslam.synthetic", description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(8)), help="rooms to draw")
    parser.add_argument("--views", type=int, default=3, help="colour images per room")
    parser.add_argument("--out", default="rooms.png", help="picture to write")
    options = parser.parse_args(arguments)

    from PIL import Image

    Image.fromarray(contact_sheet(options.seeds, views=options.views)).save(options.out)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
