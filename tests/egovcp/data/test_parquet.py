"""Opening damaged parquet files."""

import contextlib
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from egovcp.data.parquet import open_parquet
from egovcp.errors import DataError
from tests.support.limited import run_limited

_TAIL = 8  # length of the footer, 4 bytes, and the magic number


def test_no_changed_bit_of_a_footer_aborts_the_process(tmp_path: Path) -> None:
    """Some contradict the schema, on which pyarrow's metadata objects abort."""
    path = tmp_path / "file.parquet"
    pq.write_table(pa.table({"a": [[1.0], None], "b": [1, None]}), path)
    content = path.read_bytes()
    footer = range(len(content) - _TAIL - _footer_bytes(content), len(content))

    def open_all() -> int:
        for at in footer:
            for bit in range(0, 8, 2):
                damaged = bytearray(content)
                damaged[at] ^= 1 << bit
                path.write_bytes(damaged)
                with contextlib.suppress(DataError):
                    open_parquet(path).close()
        return 0

    result = run_limited(open_all, seconds=60)
    assert result.exit_code == 0, result.output


def _footer_bytes(content: bytes) -> int:
    return int.from_bytes(content[-_TAIL:-4], "little")
