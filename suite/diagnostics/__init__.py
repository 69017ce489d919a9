"""What `suite inspect` and `suite describe` show: world models beside reality, symbols, rules, sizes."""
