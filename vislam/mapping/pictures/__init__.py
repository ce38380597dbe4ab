"""Pictures of maps for reports."""
