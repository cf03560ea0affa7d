"""JSON Schema of every kind of file that a user writes: made from the readers' own schemas, and shipped with them."""
