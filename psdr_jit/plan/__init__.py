"""What a derivative render does, decided before a ray is traced: terms, form, budgets; a term's job and its motion."""
