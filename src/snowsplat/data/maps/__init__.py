"""Maps that belong to photos: depths, normals and masks, read from files and judged."""
