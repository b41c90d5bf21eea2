"""The pages of recordings and of a store."""
