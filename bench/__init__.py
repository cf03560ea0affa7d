"""What compares: the command line, experiments, peers, tables, figures and the report."""
