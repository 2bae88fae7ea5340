"""Along rays: project, back-project, and how projections change with the geometry."""
