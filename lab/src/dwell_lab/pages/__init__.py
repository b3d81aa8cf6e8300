"""Pages of campaigns and validations."""
