"""The studies, each with its plan, its runs, its tables and its figures."""
