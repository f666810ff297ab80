"""What a derivative render does, decided before a ray is traced: terms, form, budgets; and the job each term gets."""
