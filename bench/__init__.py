"""What compares: cases, runs, peers, tables, and the report."""
