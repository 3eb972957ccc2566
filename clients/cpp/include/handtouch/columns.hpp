// Parts of messages: vectors, places of contacts and columns of hand frames.
#pragma once

#include <array>
#include <optional>

#include "handtouch/msgpack.hpp"

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "columns are little-endian; this reader copies them as they are"
#endif

namespace handtouch {

template <std::size_t N>
using Vector = std::array<double, N>;

// Position, normal and covariance (row by row) in one frame; absent where unknown.
struct Place {
    std::optional<Vector<3>> position_m, normal;
    std::optional<Vector<9>> covariance_m2;
    std::string status = "not_computed";
};

// A column of a hand frame: N elements for each link; empty where no scene requests it.
template <class T, std::size_t N = 1>
class Column {
public:
    Column() = default;
    Column(std::string_view bytes, std::size_t rows) : values_(rows * N) {
        if (bytes.size() != rows * N * sizeof(T)) throw WireError("a column doesn't match its links");
        std::memcpy(values_.data(), bytes.data(), bytes.size());  // not aligned in the message
    }

    bool empty() const { return values_.empty(); }
    std::size_t size() const { return values_.size() / N; }
    const std::vector<T>& values() const { return values_; }

    // The value of a row, or a pointer to its N values. Throws std::out_of_range for a row that the column
    // lacks, as every row of one that no scene requests.
    auto operator[](std::size_t row) const {
        if (row >= size())
            throw std::out_of_range(empty() ? "the frame lacks this column: no scene requests it"
                                            : "the column has no such row");
        if constexpr (N == 1)
            return values_[row];
        else
            return &values_[row * N];
    }

private:
    std::vector<T> values_;
};

}  // namespace handtouch
