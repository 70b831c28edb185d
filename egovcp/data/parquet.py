"""Reads parquet files from untrusted sources, and their columns as arrays.

A few kilobytes of parquet can describe billions of rows, and a compressed page can hold gigabytes.
The sizes in the footer are therefore checked before anything is read.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import schema, tiff
from egovcp.data.episode import COLUMN_BYTES
from egovcp.data.features import parse_feature, values_of
from egovcp.data.paths import require_file
from egovcp.errors import DataError
from egovcp.files import require_regular
from egovcp.robot_spec import G1, RobotSpec

ROW_GROUP_ROWS: Final = 65_536
"""Largest number of rows of a row group, which is read as a whole: 0.4 GB of depth."""
_OTHER_GROUP_ROWS: Final = 1 << 20  # what pyarrow writes by default
_ROW_BYTES: Final = 65_536  # bounds a column chunk: ten times a depth image
_ROW_VALUES: Final = 4096
_COLUMNS: Final = 4096
_PADDING_BYTES: Final = 16 << 20  # page indexes and Bloom filters lie between the row groups
#: Errors that pyarrow and its callers raise on damaged files.
_READ_ERRORS: Final = (
    pa.ArrowException,
    ArithmeticError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
)

type Columns = dict[str, NDArray[Any]]

#: Array of `Episode` -> feature.
EPISODE_FEATURES = {
    "depth": spec.DEPTH_KEY,
    "state": spec.STATE_KEY,
    "action": spec.ACTION_KEY,
    "reward": spec.REWARD_KEY,
    "done": spec.DONE_KEY,
    "success": spec.SUCCESS_KEY,
    "truncated": spec.TRUNCATED_KEY,
    "reward_terms": spec.REWARD_TERMS_KEY,
    "object": spec.OBJECT_KEY,
}


@contextmanager
def data_errors(path: Path) -> Iterator[None]:
    """Turn errors of reading a damaged file into a `DataError` that names it."""
    try:
        yield
    except FileNotFoundError as error:
        raise DataError.at(path, "missing; the dataset is incomplete") from error
    except MemoryError as error:  # includes ArrowMemoryError
        raise DataError.at(path, "its content does not fit into memory") from error
    except (OSError, *_READ_ERRORS) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DataError.at(path, f"damaged: {reason}") from error


def open_parquet(path: Path, rows: int | None = None, own: bool = True) -> pq.ParquetFile:
    """Open a parquet file whose row groups can be read safely.

    The file is not memory-mapped: mapped pages count as memory of this process while the file is
    open, and truncation of the file would end the process. ``rows`` limits the number of rows.
    If not ``own``, the limits allow larger row groups and images than egovcp writes.
    """
    with data_errors(path):
        size = require_regular(path).st_size
        file = pq.ParquetFile(path)
        for problem in _row_problems(file.metadata, rows, own):
            raise DataError.at(path, problem)
        _parse_column_chunks(path)
        for problem in _column_problems(file.metadata, size, own):
            raise DataError.at(path, problem)
        return file


def _parse_column_chunks(path: Path) -> None:
    """Parse the footer's entries of all column chunks with Arrow's reader.

    `RowGroupMetaData.column` aborts the process if an entry contradicts the schema; the reader
    raises. With `pre_buffer` it parses all entries before it reads the first row.
    """
    with pq.ParquetFile(path, pre_buffer=True) as file:
        next(file.iter_batches(batch_size=1, use_threads=False), None)


def _row_problems(content: pq.FileMetaData, rows: int | None, own: bool) -> Iterator[str]:
    group_rows = ROW_GROUP_ROWS if own else _OTHER_GROUP_ROWS
    if content.num_columns > _COLUMNS:
        yield f"has {content.num_columns} columns, expected at most {_COLUMNS}"
    if content.num_rows < 0 or (rows is not None and content.num_rows > rows):
        expected = "none below 0" if rows is None else f"at most {rows}"
        yield f"has {content.num_rows} rows, expected {expected}"
    total = 0
    for number in range(content.num_row_groups):
        group = content.row_group(number)
        total += group.num_rows
        if not 0 <= group.num_rows <= group_rows:
            found = f"row group {number} has {group.num_rows} rows"
            yield f"{found}, expected at most {group_rows}"
        if group.num_columns != content.num_columns:
            found = f"row group {number} has {group.num_columns} columns"
            yield f"{found}, expected {content.num_columns}"
    if total != content.num_rows:
        yield f"has {content.num_rows} rows, but its row groups {total}"


def _column_problems(content: pq.FileMetaData, size: int, own: bool) -> Iterator[str]:
    row_bytes, row_values = (_ROW_BYTES, _ROW_VALUES) if own else (COLUMN_BYTES, COLUMN_BYTES)
    stored = content.serialized_size
    for number in range(content.num_row_groups):
        group = content.row_group(number)
        for index in range(group.num_columns):
            column = group.column(index)
            stored += max(0, column.total_compressed_size)
            rows = group.num_rows + 1
            for unit, held, limit in (
                ("bytes", column.total_uncompressed_size, min(COLUMN_BYTES, row_bytes * rows)),
                ("values", column.num_values, row_values * rows),
            ):
                if not 0 <= held <= limit:
                    name = column.path_in_schema
                    yield f"column {name} holds {held} {unit}, expected at most {limit}"
    if size > stored + _PADDING_BYTES:
        yield f"has {size} bytes, but its row groups only {stored}"


def open_data_file(root: Path, path: Path, robot: RobotSpec = G1) -> pq.ParquetFile:
    """Open a data file of the dataset at ``root`` and check its column types."""
    require_file(root, path)
    file = open_parquet(path)
    with data_errors(path):
        for problem in schema.type_problems(file.schema_arrow, robot):
            raise DataError.at(path, problem)
    return file


def read_columns(table: pa.Table, names: Iterable[str], robot: RobotSpec = G1) -> Columns:
    """Columns of a table as arrays (see `to_numpy`); absent optional columns are zeros."""
    absent = {name for name in spec.OPTIONAL_KEYS if name not in table.column_names}
    return {
        name: np.zeros((table.num_rows, schema.width(name)), np.float32)
        if name in absent
        else to_numpy(table[name], name, robot)
        for name in names
    }


def present_columns(names: Iterable[str], found: Container[str]) -> list[str]:
    """``names`` without the optional columns that are not in ``found``."""
    return [name for name in names if name in found or name not in spec.OPTIONAL_KEYS]


def to_numpy(column: pa.ChunkedArray, name: str, robot: RobotSpec = G1) -> NDArray[Any]:
    """Convert a column to (T,), (T, n) or, for depth, (T, H, W); errors have `frame` set."""
    if name == spec.DEPTH_KEY:
        return tiff.decode(column.combine_chunks().field("bytes"), *robot.depth)
    values = values_of(column, parse_feature(name, schema.feature_of(name, robot)))
    return values[:, 0] if values.shape[1] == 1 else values
