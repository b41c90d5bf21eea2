"""Pictures, tables and words -> one page that needs nothing beside itself."""
