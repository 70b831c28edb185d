"""Opens parquet files that somebody else wrote, without trusting the sizes that they claim.

A few kilobytes of parquet can describe billions of rows, and a compressed page can hold gigabytes.
What is read is therefore bounded by the footer first.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pyarrow as pa
import pyarrow.parquet as pq

from egovcp.errors import DataError
from egovcp.safe_files import UnsafeFileError, require_regular

ROW_GROUP_ROWS: Final = 65_536
"""Largest number of rows of a row group, which is read as a whole: 0.4 GB of depth."""
_ROW_BYTES: Final = 65_536  # bounds a column chunk: ten times a depth image
_ROW_VALUES: Final = 4096
_CHUNK_BYTES: Final = 1 << 30
_COLUMNS: Final = 4096
_PADDING_BYTES: Final = 16 << 20  # page indexes and Bloom filters lie between the row groups


#: What pyarrow and the code around it raise on damaged files.
_READ_ERRORS: Final = (
    pa.ArrowException,
    ArithmeticError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
)


@contextmanager
def damaged(path: Path) -> Iterator[None]:
    """Turn what is raised while a damaged file is read into a `DataError` that names it."""
    try:
        yield
    except FileNotFoundError as error:
        raise DataError.at(path, "missing; the dataset is incomplete") from error
    except UnsafeFileError as error:
        raise DataError.at(path, f"damaged: {error}") from error
    except MemoryError as error:  # ArrowMemoryError among them
        raise DataError.at(path, "its content does not fit into memory") from error
    except OSError as error:
        if error.errno is not None:
            raise
        raise _damage(path, error) from error
    except _READ_ERRORS as error:
        raise _damage(path, error) from error


def _damage(path: Path, error: Exception) -> DataError:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    return DataError.at(path, f"damaged: {reason}")


def open_parquet(path: Path, rows: int | None = None) -> pq.ParquetFile:
    """Open a parquet file whose row groups can be read safely.

    Args:
        path: a regular file, read piece by piece. It is not mapped: pages of a map count as this
            process's memory as long as the file is open, and a file that somebody cuts short would
            end it.
        rows: the largest number of rows; None: any.

    Raises:
        DataError: it is missing, damaged, or claims sizes that no dataset has.
    """
    with damaged(path):
        size = require_regular(path).st_size
        file = pq.ParquetFile(path)
        for problem in _row_problems(file.metadata, rows):
            raise DataError.at(path, problem)
        _parse_column_chunks(path)
        for problem in _column_problems(file.metadata, size):
            raise DataError.at(path, problem)
        return file


def _parse_column_chunks(path: Path) -> None:
    """Let Arrow's reader parse the footer's entry of every column chunk, and one row.

    `RowGroupMetaData.column` aborts the process where an entry contradicts the schema; the reader
    raises. With `pre_buffer` it parses all entries before it reads the first row.
    """
    with pq.ParquetFile(path, pre_buffer=True) as file:
        next(file.iter_batches(batch_size=1, use_threads=False), None)


def _row_problems(content: pq.FileMetaData, rows: int | None) -> Iterator[str]:
    if content.num_columns > _COLUMNS:
        yield f"has {content.num_columns} columns, expected at most {_COLUMNS}"
    if content.num_rows < 0 or (rows is not None and content.num_rows > rows):
        expected = "none below 0" if rows is None else f"at most {rows}"
        yield f"has {content.num_rows} rows, expected {expected}"
    total = 0
    for number in range(content.num_row_groups):
        group = content.row_group(number)
        total += group.num_rows
        if not 0 <= group.num_rows <= ROW_GROUP_ROWS:
            found = f"row group {number} has {group.num_rows} rows"
            yield f"{found}, expected at most {ROW_GROUP_ROWS}"
        if group.num_columns != content.num_columns:
            found = f"row group {number} has {group.num_columns} columns"
            yield f"{found}, expected {content.num_columns}"
    if total != content.num_rows:
        yield f"has {content.num_rows} rows, but its row groups {total}"


def _column_problems(content: pq.FileMetaData, size: int) -> Iterator[str]:
    stored = content.serialized_size
    for number in range(content.num_row_groups):
        group = content.row_group(number)
        for index in range(group.num_columns):
            column = group.column(index)
            stored += max(0, column.total_compressed_size)
            limit = min(_CHUNK_BYTES, _ROW_BYTES * (group.num_rows + 1))
            if not 0 <= column.total_uncompressed_size <= limit:
                found = f"holds {column.total_uncompressed_size} bytes"
                yield f"column {column.path_in_schema} {found}, expected at most {limit}"
            values = _ROW_VALUES * (group.num_rows + 1)
            if not 0 <= column.num_values <= values:
                found = f"holds {column.num_values} values"
                yield f"column {column.path_in_schema} {found}, expected at most {values}"
    if size > stored + _PADDING_BYTES:
        yield f"has {size} bytes, but its row groups only {stored}"
