"""An OPC UA server for the tests; run as a script.

`python opcua_server.py PORT [FOLDER]` serves the numbers `heater` and `T1` in namespace 2. Each
line of stdin, "NODE VALUE STATUS MILLISECONDS", writes a value with a status and a time after 2026
began.
With a folder, messages are signed and encrypted by its cert.pem and key.pem, only the application
of client.pem is trusted, and only the user "watch" with the password "secret" is let in.
"""

from __future__ import annotations

import asyncio
import logging
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

from asyncua import Server, ua
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.crypto.truststore import TrustStore
from asyncua.crypto.validator import CertificateValidator, CertificateValidatorOptions

BEGIN = datetime(2026, 1, 1, tzinfo=UTC)


class Users:
    """Lets one user in."""

    def get_user(self, iserver, username=None, password=None, certificate=None):
        return (
            User(UserRole.User, username) if (username, password) == ("watch", "secret") else None
        )


async def main(port: int, folder: Path | None = None) -> None:
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    server = Server(user_manager=Users() if folder else None)
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}/")
    if folder is None:
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    else:
        server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
        await server.load_certificate(folder / "cert.pem")
        await server.load_private_key(folder / "key.pem")
        await server.set_application_uri("urn:tests:server")
        trusted = TrustStore([folder / "trusted"], [])
        await trusted.load()
        server.set_certificate_validator(
            CertificateValidator(CertificateValidatorOptions.TRUSTED_VALIDATION, trusted)
        )
    space = await server.register_namespace("tests")
    assert space == 2
    nodes = {}
    for name in ("heater", "T1"):
        node = ua.NodeId(name, space)
        nodes[name] = await server.nodes.objects.add_variable(node, name, 0.0)
    lines = asyncio.StreamReader()
    protocol = asyncio.StreamReaderProtocol(lines)
    await asyncio.get_running_loop().connect_read_pipe(lambda: protocol, sys.stdin)
    async with server:
        print("ready", flush=True)
        while line := await lines.readline():
            name, value, status, milliseconds = line.decode().split()
            time = BEGIN + timedelta(milliseconds=int(milliseconds))
            kind = ua.Variant(float(value), ua.VariantType.Double)
            code = ua.StatusCode(getattr(ua.StatusCodes, status))
            await nodes[name].write_value(ua.DataValue(kind, code, SourceTimestamp=time))


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1]), *map(Path, sys.argv[2:])))
