"""Local server for pages in the user's browser, which other users and other sites can neither read nor steer."""
