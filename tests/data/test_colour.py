"""Colours of files that are not in sRGB: against the definitions of Display P3 and of PNG's `gAMA`."""

import io
import struct
import zlib

import numpy as np
import pytest
from data.test_inspect import FOCAL, SIDE, six
from PIL import Image, ImageCms

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import images, inspect_figures
from mi_ntf.data.schema import Camera, View

cv2 = pytest.importorskip("cv2", reason="TIFF needs OpenCV: pip install 'mi-ntf[train]'")

TO_XYZ = {
    "Display P3": np.array([[0.51512, 0.29198, 0.15710], [0.24120, 0.69225, 0.06657], [-0.00105, 0.04189, 0.78407]]),
    "sRGB": np.array([[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]]),
}
"""From linear light to XYZ, adapted to D50 (profiles of both spaces)."""
SRGB = ("para", struct.pack(">HHiiiii", 3, 0, *(round(65536 * v) for v in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92,
                                                                          0.04045))))
LINEAR = ("curv", struct.pack(">II", 0, 0)[:8])


def profile(space: str, curve=SRGB, kind: bytes = b"RGB ") -> bytes:
    """Return a matrix profile after ICC.1:2004-10, version 4."""
    s15 = lambda values: b"XYZ \0\0\0\0" + b"".join(struct.pack(">i", round(65536 * v)) for v in values)  # noqa: E731
    code, data = curve
    tone = code.encode() + (b"\0\0\0\0" + data if code == "para" else data)
    text = space.encode("utf-16-be")
    title = b"mluc\0\0\0\0" + struct.pack(">II2s2sII", 1, 12, b"en", b"US", len(text), 28) + text
    tags = {b"desc": title, b"cprt": title, b"wtpt": s15((0.96420, 1, 0.82491))}
    if kind == b"GRAY":
        tags[b"kTRC"] = tone
    else:
        tags |= {name + b"XYZ": s15(TO_XYZ[space][:, k]) for k, name in enumerate((b"r", b"g", b"b"))}
        tags |= {name + b"TRC": tone for name in (b"r", b"g", b"b")}
    body, table, at = b"", struct.pack(">I", len(tags)), 132 + 12 * len(tags)
    for name, data in tags.items():
        data += b"\0" * (-len(data) % 4)
        table += name + struct.pack(">II", at + len(body), len(data))
        body += data
    head = struct.pack(">I4sI4s4s4s", 128 + len(table) + len(body), b"\0\0\0\0", 0x04000000, b"mntr", kind, b"XYZ ")
    head += b"\0" * 12 + b"acsp" + b"\0" * 28 + struct.pack(">3i", *(round(65536 * v) for v in (0.9642, 1, 0.8249)))
    return head.ljust(128, b"\0") + table + body


def light(levels) -> np.ndarray:
    v = np.asarray(levels) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


COLOURS = np.array([[200, 120, 90], [90, 140, 60], [70, 80, 160], [128, 128, 128], [20, 30, 25]], np.uint8)
"""All of them within sRGB when they are meant in Display P3."""
PICTURE = np.repeat(np.repeat(COLOURS[None], 8, 0), 8, 1)


def decoded(path) -> np.ndarray:
    return images.read_image(path)[4, 4::8, :3]


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif", "alpha.png", "palette.png"])
def test_display_p3(tmp_path, name):
    """Within a level and a half, rounding of the file and of storing; JPEG as much again."""
    image = Image.fromarray(PICTURE)
    if name == "alpha.png":
        image.putalpha(255)
    image = image.quantize(8) if name == "palette.png" else image
    more = {"quality": 100, "subsampling": 0} if name == "a.jpg" else {}
    image.save(tmp_path / name, icc_profile=profile("Display P3"), **more)
    expected = light(COLOURS) @ TO_XYZ["Display P3"].T @ np.linalg.inv(TO_XYZ["sRGB"]).T
    assert np.abs(expected / light(COLOURS) - 1).max() > 0.2, "the oracle would find no difference"
    np.testing.assert_allclose(decoded(tmp_path / name), expected, atol=(3 if name == "a.jpg" else 1.5) * 2.3 / 255)
    assert images.decode(tmp_path / name).assumed == (
        "colours are converted from the ICC profile 'Display P3' to sRGB",)


def test_thumbnails_have_the_same_colours(tmp_path):
    """The background comes from the file: outside of the mask it is dimmed to 0.3 and bluish, inside it is as it is."""
    split, path = six()["train"], tmp_path / "a.png"
    Image.new("RGB", (SIDE, SIDE), tuple(COLOURS[0].tolist())).save(path, icc_profile=profile("Display P3"))
    view = View("", path, "a.png", [], split.c2w[0], Camera(FOCAL, FOCAL, SIDE / 2, SIDE / 2))
    shown = inspect_figures.thumbnail(split, 0, view, 1.0)[120, 120]
    np.testing.assert_allclose(images.LINEAR[shown], decoded(path)[0], atol=2.3 / 255)


def test_grey_profiles(tmp_path):
    """A linear grey; and grey with a profile of RGB, which some programs leave there."""
    grey = Image.fromarray(PICTURE[..., 0])
    grey.save(tmp_path / "l.png", icc_profile=profile("grey", LINEAR, b"GRAY"))
    np.testing.assert_allclose(decoded(tmp_path / "l.png")[:, 1], COLOURS[:, 0] / 255, atol=0.6 * 2.3 / 255)
    grey.save(tmp_path / "p.png", icc_profile=profile("Display P3"))
    np.testing.assert_allclose(decoded(tmp_path / "p.png")[:, 1], light(COLOURS[:, 0]), atol=1.5 * 2.3 / 255)


@pytest.mark.parametrize("icc", [profile("sRGB"), ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()],
                         ids=["ours", "lcms"])  # the second has the time in it
def test_srgb_profiles_leave_the_levels_alone(tmp_path, icc):
    Image.fromarray(PICTURE).save(tmp_path / "a.png", icc_profile=icc)
    image = images.decode(tmp_path / "a.png")
    np.testing.assert_array_equal(image.rgb, PICTURE)
    assert image.assumed == ()


def test_a_profile_that_is_none_is_refused(tmp_path):
    Image.fromarray(PICTURE).save(tmp_path / "a.png", icc_profile=b"no profile" * 20)
    with pytest.raises(MiNtfError, match=r"a.png: its ICC profile cannot be used \(.*\); convert it to sRGB, or take"):
        images.decode(tmp_path / "a.png")


def with_chunks(path, *chunks) -> None:
    """PICTURE as PNG with further chunks (type, data)."""
    buffer = io.BytesIO()
    Image.fromarray(PICTURE).save(buffer, "png")
    raw = buffer.getvalue()
    extra = b"".join(struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
                     for name, data in chunks)
    path.write_bytes(raw[:33] + extra + raw[33:])


@pytest.mark.parametrize(("chunks", "expected"), [
    ([(b"gAMA", struct.pack(">I", 100000))], COLOURS / 255),
    ([(b"gAMA", struct.pack(">I", 55556))], (COLOURS / 255) ** 1.8),
    ([(b"gAMA", struct.pack(">I", 45455))], light(COLOURS)),
    ([(b"gAMA", struct.pack(">I", 100000)), (b"sRGB", b"\0")], light(COLOURS)),
    ([(b"gAMA", struct.pack(">I", 0))], light(COLOURS)),
    ([(b"cHRM", struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000))], light(COLOURS)),
], ids=["linear", "1.8", "sRGB's", "sRGB goes before", "none", "primaries of sRGB"])
def test_gamma_of_png(tmp_path, chunks, expected):
    with_chunks(tmp_path / "a.png", *chunks)
    np.testing.assert_allclose(decoded(tmp_path / "a.png"), expected, atol=0.6 * 2.3 / 255)


def test_primaries_of_png_are_refused(tmp_path):
    p3 = struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)
    with_chunks(tmp_path / "a.png", (b"cHRM", p3))
    with pytest.raises(MiNtfError, match=r"a.png: its chunk cHRM says primaries .0.68, .* others than sRGB's; convert"):
        images.decode(tmp_path / "a.png")


@pytest.mark.parametrize(("icc", "fault"), [
    (profile("sRGB", LINEAR), None), (profile("sRGB"), "'sRGB'"), (profile("Display P3", LINEAR), "'Display P3'")])
def test_deep_tiff_is_linear_or_refused(tmp_path, icc, fault):
    """Pillow writes no 16 bits of RGB, OpenCV no profile: the tag is added to OpenCV's file."""
    cv2.imwrite(str(tmp_path / "a.tif"), PICTURE[..., ::-1].astype(np.uint16) * 257,
                [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    raw = bytearray((tmp_path / "a.tif").read_bytes())
    at = struct.unpack_from("<I", raw, 4)[0]
    count = struct.unpack_from("<H", raw, at)[0]
    entries = bytes(raw[at + 2:at + 2 + 12 * count]) + struct.pack("<HHII", 34675, 7, len(icc), len(raw))
    struct.pack_into("<I", raw, 4, len(raw) + len(icc))
    (tmp_path / "a.tif").write_bytes(bytes(raw) + icc + struct.pack("<H", count + 1) + entries + b"\0\0\0\0")
    if fault is None:
        np.testing.assert_allclose(decoded(tmp_path / "a.tif"), COLOURS / 255, rtol=1e-6)
        return
    with pytest.raises(MiNtfError, match=rf"a.tif: its ICC profile is {fault}; TIFF of more than 8 bits is read as"):
        images.decode(tmp_path / "a.tif")


def test_adobe_rgb_of_cameras_is_refused(tmp_path):
    """Cameras write no profile, but the interoperability index of Exif."""
    tags = Image.Exif()
    tags.get_ifd(0x8769)[0xA005] = {1: "R03"}
    Image.fromarray(PICTURE).save(tmp_path / "_a.jpg", exif=tags, quality=100)
    with pytest.raises(MiNtfError, match=r"_a.jpg: its Exif tags say Adobe RGB, and it has no ICC profile; convert it"):
        images.decode(tmp_path / "_a.jpg")
