"""Arrays and what a user gives for them. Knows no robot and no solver."""
