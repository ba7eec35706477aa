"""The plant held against the thesis, row by row (R01 to R16): `hannes validate`."""
