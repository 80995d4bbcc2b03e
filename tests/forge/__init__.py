"""What tests are made of: pictures, data sets, models, scores, pages, people and servers."""
