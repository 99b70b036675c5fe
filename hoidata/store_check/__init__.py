"""Whether a store keeps what its field table says; the field table as a README."""
