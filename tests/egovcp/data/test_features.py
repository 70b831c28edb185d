"""Values of features."""

import pyarrow as pa
import pytest

from egovcp.data.features import parse_feature, values_of
from egovcp.errors import SchemaError


@pytest.mark.parametrize(
    ("rows", "given"), [([0.0], "holds single values"), ([[0.0, 0.0]], "holds lists nested 1 deep")]
)
def test_a_column_with_too_few_levels_of_lists_is_described(rows: list[object], given: str) -> None:
    feature = parse_feature("grid", {"dtype": "float32", "shape": [2, 3]})
    column = pa.chunked_array([pa.array(rows)])
    with pytest.raises(SchemaError, match=rf"grid {given}, but its shape is \[2, 3\]"):
        values_of(column, feature)
