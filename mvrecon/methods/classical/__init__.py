"""Classical reconstruction: filtered back-projection, and iterations with any linear operator."""
