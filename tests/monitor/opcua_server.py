"""An OPC UA server for the tests; run as a script.

`python opcua_server.py PORT` serves the numbers `heater` and `T1` in namespace 2. Each line of
stdin, "NODE VALUE STATUS MILLISECONDS", writes a value with a status and a time after 2026 began.
"""

from __future__ import annotations

import asyncio
import logging
import sys
from datetime import UTC, datetime, timedelta

from asyncua import Server, ua

BEGIN = datetime(2026, 1, 1, tzinfo=UTC)


async def main(port: int) -> None:
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    server = Server()
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}/")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
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
    asyncio.run(main(int(sys.argv[1])))
