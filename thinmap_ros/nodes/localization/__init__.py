"""Parts of the localizer: localization in a given map, as AMCL's users expect it."""
