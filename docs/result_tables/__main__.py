"""Write the pages."""

from docs.result_tables.pages import main

main()
