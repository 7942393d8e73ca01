"""The bytes of the files under meta/: the same content always makes the same ones."""

import io
import json
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq


def parquet_bytes(table: pa.Table | None) -> bytes:
    """A Parquet file, with a checksum on every page."""
    file = io.BytesIO()
    if table is not None:
        # Read back, a list's elements have another name: the same content is to make the same bytes.
        kinds = [pa.field(f.name, _as_made(f.type)) for f in table.schema]
        table = table.cast(pa.schema(kinds, metadata=table.schema.metadata))
    pq.write_table(table, file, write_page_checksum=True)
    return file.getvalue()


def _as_made(kind: pa.DataType) -> pa.DataType:
    return pa.list_(_as_made(kind.value_type)) if pa.types.is_list(kind) else kind


def json_bytes(value: Any) -> bytes:
    """A JSON file that a person can read."""
    return json.dumps(value, indent=1, allow_nan=False).encode()
