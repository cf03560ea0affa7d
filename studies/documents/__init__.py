"""Update of tables, figures and reports in the documents."""
