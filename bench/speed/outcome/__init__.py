"""Records of the speed benchmark, and what is made of them: tables, figures, files."""
