// The fields of every row, from which Python builds its own structs and array types.

#include "export.h"
#include "rows.h"

namespace dwell {
namespace {

struct Field {
  const char* row;
  const char* name;
  const char* type;
};

// Writes the fields of all rows, then every table as a field of `Tables` with the type of its rows,
// unless `out` is null; returns the number of fields.
i64 describe(Field* out) {
  i64 n = 0;
  const auto add = [&](const Field& field) {
    if (out != nullptr) out[n] = field;
    ++n;
  };
#define DWELL_FIELD(type, name) add({kName, #name, #type});
#define DWELL_DESCRIBE(row, fields)     \
  {                                     \
    constexpr const char* kName = #row; \
    fields(DWELL_FIELD)                 \
  }
#define DWELL_TABLES_FIELDS(field) DWELL_TABLES(field)
  DWELL_ROWS(DWELL_DESCRIBE)
  DWELL_DESCRIBE(Tables, DWELL_TABLES_FIELDS)
  return n;
}

}  // namespace
}  // namespace dwell

DWELL_EXPORT dwell::i64 dwell_layout(dwell::Field* out) noexcept { return dwell::describe(out); }
