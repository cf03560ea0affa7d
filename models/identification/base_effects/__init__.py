"""What a base does around its linear dynamics, estimated from records."""
