"""Certificates for the tests, signed by an authority of their own."""

from __future__ import annotations

import ipaddress
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID


class Authority:
    """An authority, whose certificate is `ca.pem` in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._key = rsa.generate_private_key(65537, 2048)
        self._name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "tests")])
        self._write("ca", self._name, self._key, x509.BasicConstraints(True, None))

    def certify(self, name: str, uri: str) -> tuple[Path, Path]:
        """A certificate of a program on this machine, and its key."""
        key = rsa.generate_private_key(65537, 2048)
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        loopback = x509.IPAddress(ipaddress.ip_address("127.0.0.1"))
        names = [x509.UniformResourceIdentifier(uri), loopback, x509.DNSName("localhost")]
        both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        usage = x509.KeyUsage(True, True, True, True, False, False, False, False, False)
        extensions = [x509.SubjectAlternativeName(names), x509.ExtendedKeyUsage(both), usage]
        return self._write(name, subject, key, *extensions)

    def _write(
        self, name: str, subject: x509.Name, key: rsa.RSAPrivateKey, *extensions: x509.ExtensionType
    ) -> tuple[Path, Path]:
        now = datetime.now(UTC)
        made = x509.CertificateBuilder(
            self._name,
            subject,
            key.public_key(),
            x509.random_serial_number(),
            now - timedelta(days=1),
            now + timedelta(days=2),
        )
        for each in extensions:
            made = made.add_extension(each, isinstance(each, x509.BasicConstraints))
        signed = made.sign(self._key, hashes.SHA256())
        files = self._folder / f"{name}.pem", self._folder / f"{name}-key.pem"
        files[0].write_bytes(signed.public_bytes(Encoding.PEM))
        private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        files[1].write_bytes(private)
        return files
