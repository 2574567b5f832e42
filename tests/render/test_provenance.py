"""Marks of synthetic images and videos, written and read back."""

import datetime
import io

import numpy as np
import pytest
from PIL import Image

from gsgan.render.output import encoded
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.provenance import (
    SOURCE_TYPE,
    Signer,
    marked_mp4,
    png_bytes,
    signed,
    verify,
)

PIXELS = np.arange(16 * 16 * 3, dtype=np.uint8).reshape(16, 16, 3)


@pytest.fixture
def png(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(png_bytes(Image.fromarray(PIXELS)))
    return path


@pytest.fixture
def mp4(tmp_path):
    pytest.importorskip("av")
    path = tmp_path / "a.mp4"
    path.write_bytes(marked_mp4(encoded(iter([PIXELS] * 3), 30)))
    return path


def test_a_png_says_so_and_keeps_its_pixels(png, tmp_path):
    found = verify(png)
    assert found.synthetic
    assert found.source_type == SOURCE_TYPE
    assert found.software.startswith("gsgan ")
    with Image.open(png) as image:
        np.testing.assert_array_equal(np.asarray(image), PIXELS)
        packet = image.getxmp() if hasattr(image, "getxmp") else {}
    assert "trainedAlgorithmicMedia" in str(packet or image.info)
    plain = tmp_path / "b.png"
    plain.write_bytes(png_bytes(Image.fromarray(PIXELS), marked=False))
    assert not verify(plain).synthetic
    assert verify(plain).lines() == [
        "metadata: none that states an origin",
        "content credentials: none",
    ]


def test_a_video_says_so_and_still_plays(mp4):
    import av

    assert verify(mp4).synthetic
    with av.open(str(mp4)) as container:
        assert len(list(container.decode(video=0))) == 3


def test_other_programs_metadata_is_read(tmp_path):
    """As elements, in a JPEG."""
    xmp = (
        "<x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:RDF><rdf:Description>"
        f"<Iptc4xmpExt:DigitalSourceType>{SOURCE_TYPE}</Iptc4xmpExt:DigitalSourceType>"
        "<xmp:CreatorTool>Other 2</xmp:CreatorTool></rdf:Description></rdf:RDF></x:xmpmeta>"
    )
    stream = io.BytesIO()
    Image.fromarray(PIXELS).save(stream, "JPEG", xmp=xmp.encode())
    path = tmp_path / "a.jpg"
    path.write_bytes(stream.getvalue())
    assert verify(path).synthetic
    assert verify(path).software == "Other 2"


def test_files_that_cannot_be_read(png, mp4, tmp_path):
    png.write_bytes(png.read_bytes()[:200])
    mp4.write_bytes(mp4.read_bytes()[:200])
    (tmp_path / "a.txt").write_text("")
    for path, message in (
        (png, "is damaged"), (mp4, "is damaged"), (tmp_path / "a.txt", "of no format"),
        (tmp_path / "none.png", "cannot be read"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=message):
            verify(path)


@pytest.fixture(scope="module")
def signer(tmp_path_factory):
    """A certificate for content credentials, of an authority of its own."""
    pytest.importorskip("c2pa")
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    def name(text: str) -> x509.Name:
        parts = ((NameOID.ORGANIZATION_NAME, "Tests"), (NameOID.COMMON_NAME, text))
        return x509.Name([x509.NameAttribute(oid, value) for oid, value in parts])

    keys = [ec.generate_private_key(ec.SECP256R1()) for _ in range(2)]
    now = datetime.datetime.now(datetime.UTC)
    chain = []
    for k, (subject, issuer) in enumerate((("Signer", "Root"), ("Root", "Root"))):
        root = k == 1
        usage = dict.fromkeys(
            ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement",
             "encipher_only", "decipher_only"), False,
        )  # fmt: skip
        builder = (
            x509.CertificateBuilder()
            .subject_name(name(subject))
            .issuer_name(name(issuer))
            .public_key(keys[k].public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(days=1))
            .not_valid_after(now + datetime.timedelta(days=30))
            .add_extension(
                x509.BasicConstraints(ca=root, path_length=None), critical=True
            )
            .add_extension(
                x509.KeyUsage(
                    digital_signature=not root,
                    key_cert_sign=root,
                    crl_sign=root,
                    **usage,
                ),
                critical=True,
            )
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_public_key(
                    keys[1].public_key()
                ),
                critical=False,
            )
            .add_extension(
                x509.SubjectKeyIdentifier.from_public_key(keys[k].public_key()),
                critical=False,
            )
        )
        if not root:
            purpose = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.EMAIL_PROTECTION])
            builder = builder.add_extension(purpose, critical=False)
        chain.append(builder.sign(keys[1], hashes.SHA256()))
    folder = tmp_path_factory.mktemp("signer")
    pem = serialization.Encoding.PEM
    (folder / "chain.pem").write_bytes(b"".join(c.public_bytes(pem) for c in chain))
    (folder / "key.pem").write_bytes(
        keys[0].private_bytes(
            pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    )
    return Signer(folder / "chain.pem", folder / "key.pem")


def test_content_credentials(png, mp4, signer, tmp_path):
    for path in (png, mp4):
        path.write_bytes(signed(path.read_bytes(), path.suffix, signer))
        found = verify(path)
        assert found.credentials is not None, found
        assert found.credentials["state"] == "Valid", found
        assert found.credentials["source_type"] == SOURCE_TYPE
        assert found.credentials["issuer"] == "Tests"
        assert found.source_type == SOURCE_TYPE  # the XMP is still there
        assert found.synthetic
    with Image.open(png) as image:
        np.testing.assert_array_equal(np.asarray(image), PIXELS)
    data = bytearray(mp4.read_bytes())
    at = data.rfind(b"mdat") + 40
    data[at] ^= 255
    mp4.write_bytes(bytes(data))
    assert verify(mp4).credentials["state"] == "Invalid"


def test_a_wrong_key_is_one_sentence(png, signer, tmp_path):
    (tmp_path / "key.pem").write_text("no key")
    for wrong in (
        Signer(signer.certificate, tmp_path / "key.pem"),
        Signer(tmp_path / "x", signer.key),
    ):
        with pytest.raises(ConfigError, match="cannot sign"):
            signed(png.read_bytes(), ".png", wrong)
