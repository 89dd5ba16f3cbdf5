"""Pictures of flat textured surfaces, from cameras whose poses are exact."""
