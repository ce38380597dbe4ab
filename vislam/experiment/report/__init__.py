"""What a comparison shows: tables, plots and the page that holds them."""
