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
        raise DataError.at(path, "damaged: its content does not fit into memory") from error
    except OSError as error:
        if error.errno is not None:
            raise
        raise _damage(path, error) from error
    except (pa.ArrowException, ArithmeticError, ValueError, TypeError, LookupError) as error:
        raise _damage(path, error) from error
    except RecursionError as error:
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
        for problem in _size_problems(file.metadata, size, rows):
            raise DataError.at(path, problem)
        return file


def _size_problems(content: pq.FileMetaData, size: int, rows: int | None) -> Iterator[str]:
    if content.num_columns > _COLUMNS:
        yield f"has {content.num_columns} columns, expected at most {_COLUMNS}"
    if content.num_rows < 0 or (rows is not None and content.num_rows > rows):
        expected = "none below 0" if rows is None else f"at most {rows}"
        yield f"has {content.num_rows} rows, expected {expected}"
    total, stored = 0, content.serialized_size
    for number in range(content.num_row_groups):
        group = content.row_group(number)
        total += group.num_rows
        if not 0 <= group.num_rows <= ROW_GROUP_ROWS:
            found = f"row group {number} has {group.num_rows} rows"
            yield f"{found}, expected at most {ROW_GROUP_ROWS}"
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
    if total != content.num_rows:
        yield f"has {content.num_rows} rows, but its row groups {total}"
    if size > stored + _PADDING_BYTES:
        yield f"has {size} bytes, but its row groups only {stored}"
