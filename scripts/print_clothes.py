"""Prints letters and fine stripes on the clothes of a rigged character.

    python scripts/print_clothes.py character.glb printed.glb 0.63,0.46,1.0,1.0 0.63,0.17,0.83,0.4

The boxes are left,top,right,bottom of the colour texture, as shares of its sides; of their pixels,
those as bright as cloth are printed on. It makes the strangers with fine print of
docs/results/real_size.md: the coat of VALID's Asian_M_2_Medi by the line above, and the shirt of
its Black_F_1_Casual with --cloth 90 and the boxes 0.665,0.46,0.985,1.0 0.63,0.15,0.82,0.4
0.04,0.75,0.18,1.0.
"""

import argparse
import json
import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

TEXT = "GAUSSIAN AVATAR 0123456789"
TEXT_WIDTH = 560  # pixels of a 2048² texture
LINE_HEIGHT = 44
STRIPE = 11


def pattern(height: int, width: int) -> NDArray[np.uint8]:
    """``[height, width, 3]`` BGR: lines of letters, red and blue, over thin stripes."""
    printed = np.full((height, width, 3), 255, np.uint8)
    printed[:, ::STRIPE] = (170, 190, 120)
    for row, bottom in enumerate(
        range(LINE_HEIGHT, height + LINE_HEIGHT, LINE_HEIGHT)
    ):
        colour = (40, 40, 190) if row % 2 else (150, 60, 20)
        for left in range(-97 * (row % 3), width, TEXT_WIDTH):
            place = (left, bottom)
            cv2.putText(
                printed, TEXT, place, cv2.FONT_HERSHEY_DUPLEX, 1.0, colour, 3
            )
    return printed


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("source", type=Path, help="a character, .glb")
    parser.add_argument("target", type=Path, help="the .glb that is written")
    parser.add_argument("boxes", nargs="+", help="left,top,right,bottom")
    parser.add_argument(
        "--cloth",
        type=int,
        default=150,
        help="of 255: pixels whose darkest channel is at most this are no cloth",
    )
    options = parser.parse_args()

    # A .glb is a header, a JSON chunk and a binary chunk. They are written here because pygltflib
    # joins all buffers when it saves, and compressed meshes would be lost.
    data = options.source.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    scene = json.loads(data[20 : 20 + length])
    binary = bytearray(data[28 + length :])

    # The colour texture of the first material.
    material = scene["materials"][0]["pbrMetallicRoughness"]
    texture = scene["textures"][material["baseColorTexture"]["index"]]
    number = texture.get("source")
    if number is None:
        number = texture["extensions"]["EXT_texture_webp"]["source"]
    image = scene["images"][number]
    view = scene["bufferViews"][image["bufferView"]]
    start = view.get("byteOffset", 0)
    stored = np.frombuffer(binary[start : start + view["byteLength"]], np.uint8)
    colours = cv2.imdecode(stored, cv2.IMREAD_COLOR)

    # The print multiplies the cloth's colour.
    height, width = colours.shape[:2]
    printed = pattern(height, width)
    for box in options.boxes:
        left, top, right, bottom = map(float, box.split(","))
        rows = slice(round(top * height), round(bottom * height))
        columns = slice(round(left * width), round(right * width))
        part = colours[rows, columns]
        cloth = part.min(axis=2, keepdims=True) > options.cloth
        dyed = (part.astype(float) * printed[rows, columns] / 255).astype(
            np.uint8
        )
        part[:] = np.where(cloth, dyed, part)

    # The new image is appended to the binary chunk.
    _, encoded = cv2.imencode(".webp", colours, [cv2.IMWRITE_WEBP_QUALITY, 95])
    binary += b"\0" * (-len(binary) % 4)
    scene["bufferViews"].append(
        {
            "buffer": view["buffer"],
            "byteOffset": len(binary),
            "byteLength": encoded.size,
        }
    )
    image["bufferView"] = len(scene["bufferViews"]) - 1
    image["mimeType"] = "image/webp"
    binary += encoded.tobytes()
    binary += b"\0" * (-len(binary) % 4)
    scene["buffers"][view["buffer"]]["byteLength"] = len(binary)

    # Both chunks end at multiples of four bytes.
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(binary)
    parts = (
        struct.pack("<4sII", b"glTF", 2, total),
        struct.pack("<I4s", len(text), b"JSON"),
        text,
        struct.pack("<I4s", len(binary), b"BIN\0"),
        bytes(binary),
    )
    options.target.write_bytes(b"".join(parts))


if __name__ == "__main__":
    main()
