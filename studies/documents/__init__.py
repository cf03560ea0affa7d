"""Generation of tables, figures and reports in the documents."""
